"""The hull cannot pass through the floor or an object: contact is found exactly, at any timestep, and ends a survey."""

from __future__ import annotations

import numpy as np
import pytest

import twin
from twin import survey
from twin.core import geometry
from twin.errors import SurveyAborted
from twin.scenario.file import load_scenario
from twin.scenario.model import VehicleConfig
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.contact import HullBox, floor_field, touches_floor
from twin.simulate.parameters import parameters_of
from twin.simulate.sea import steady_current
from twin.surrogate import surrogate_world
from twin.terrains import Terrain
from twin.terrains.objects.coloured_mesh import mesh_of
from twin.terrains.objects.placed_object import PlacedObject, model_of
from twin.terrains.objects.primitives import sphere
from twin.world.mission import prepare
from twin.world.obstacles import Obstacles

SMALL = [
    "terrain.size_m=[5.0, 4.0]", "rig.image_width_px=96", "rig.image_height_px=72", "rig.frame_rate_hz=15",
    "plan.area_m=[0.4, 0.4]", "plan.altitude_m=1.5", "plan.tracks=1", "control.hold_s=0.4",
]  # fmt: skip
SURROGATE = ["imaging.fidelity=surrogate", "imaging.extrapolate=true"]
HALF_M, CENTRE_M = parameters_of(VehicleConfig()).half_size_m, parameters_of(VehicleConfig()).hull_centre_m
BOX = HullBox(HALF_M, CENTRE_M)
DOWN = np.r_[np.zeros(4), np.full(4, -1.0)]


def at(x, y, z, rotation=None):
    return geometry.pose(np.eye(3) if rotation is None else rotation, np.array([x, y, z], float))


def test_a_level_hull_touches_a_level_floor_where_its_lower_side_reaches_it():
    floor, bottom = floor_field(np.full((41, 61), 0.3, np.float32), 0.1, -3.0, -2.0, BOX), HALF_M[2] - CENTRE_M[2]
    for x, y in [(0.0, 0.0), (-2.9, 1.93), (2.97, -1.99)]:
        assert touches_floor(floor, at(x, y, np.float32(0.3) + bottom - 1e-6))
        assert not touches_floor(floor, at(x, y, np.float32(0.3) + bottom + 1e-6))
    assert touches_floor(floor, at(0, 0, -5.0)) and not touches_floor(floor, at(9.0, 0, -5.0))


@pytest.mark.parametrize("slope", [-0.36, 0.36])
def test_a_hull_above_a_steep_plane_of_coarse_cells_touches_nothing(slope):
    """The highest corner of a cell lies above the hull, the floor below the hull does not."""
    east_m = 10.0 * np.arange(7)
    plane = np.tile((slope * east_m).astype(np.float32), (7, 1))
    for heights, (dx, dy) in ((plane, (1, 0)), (plane.T, (0, 1))):
        floor = floor_field(heights, 10.0, 0.0, 0.0, BOX)
        for x in np.arange(21.0, 30.0):
            centre = slope * x + 2.2
            assert not touches_floor(floor, at(25 + (x - 25) * dx, 25 + (x - 25) * dy, centre))
            assert touches_floor(floor, at(25 + (x - 25) * dx, 25 + (x - 25) * dy, slope * x - 0.5))


@pytest.mark.parametrize("seed", range(3))
def test_contact_with_relief_agrees_with_points_sampled_on_the_hull(seed):
    """No point of the hull is below the floor where there is no contact; 5 mm farther down, one is."""
    rng = np.random.default_rng(seed)
    spacing, heights = 0.04, rng.normal(0, 0.03, (60, 60)).astype(np.float32)
    floor = floor_field(heights, spacing, -1.2, -1.2, BOX)
    rotation = geometry.rotation_from_rpy(*rng.normal(0, 0.3, 3))
    low, high = -1.0, 1.0
    for _ in range(30):
        middle = (low + high) / 2
        low, high = (middle, high) if touches_floor(floor, at(0.1, -0.2, middle, rotation)) else (low, middle)
    clear = [_least_gap(heights, spacing, at(0.1, -0.2, high + dz, rotation)) for dz in (1e-6, -0.005)]
    assert clear[0] > -1e-4 and clear[1] < 0


def _least_gap(heights, spacing, pose):
    """Returns the least height of the surface of the hull above the floor, at points 2 mm apart."""
    floor = Terrain(heights, spacing, -1.2, -1.2, np.zeros((2, 2, 3), np.uint8), 1.18)
    u, v, w = (np.linspace(-h, h, round(h / 0.002) + 1) for h in HALF_M)
    sides = [
        np.stack(np.meshgrid(*axes), axis=-1).reshape(-1, 3)
        for k in range(3)
        for end in (-1, 1)
        for axes in [[[end * HALF_M[k]] if j == k else (u, v, w)[j] for j in range(3)]]
    ]
    points = geometry.transform(pose, np.concatenate(sides) + CENTRE_M)
    return float(np.nanmin(points[:, 2] - floor.height_at(points[:, 0], points[:, 1])))


def test_a_hull_beside_an_object_is_free_and_one_at_its_side_touches_it():
    """The bounding spheres meet in both cases; the ball of 0.3 m stands beside the bow at the height of the hull."""
    ball = PlacedObject(model_of(mesh_of(*sphere(), (1, 1, 1))), np.diag([0.3, 0.3, 0.3, 1.0]), 0.3, 4)
    pose = ball.world_from_object
    pose[:3, 3] = [HALF_M[0] + 0.3, 0.0, 1.0]  # its centre is 0.3 m higher
    mission = prepare(load_scenario("reef", SMALL))
    object.__setattr__(mission, "objects", (ball,))
    obstacles = Obstacles(mission)
    z = 1.3 - CENTRE_M[2]
    assert obstacles.touched(at(-0.005, 0, z)) == "" and obstacles.touched(at(-0.2, 0, z)) == ""
    assert obstacles.touched(at(0.005, 0, z)) == "an object (objects.4)"


def test_the_compiled_vehicle_stops_at_the_timestep_of_the_contact():
    floor = floor_field(np.zeros((41, 41), np.float32), 0.1, -2.0, -2.0, BOX)
    body = CompiledVehicle(VehicleConfig(), steady_current(np.zeros(3)), at(0, 0, 1.0), 1 / 120, floor)
    free = CompiledVehicle(VehicleConfig(), steady_current(np.zeros(3)), at(0, 0, 1.0), 1 / 120)
    with pytest.raises(SurveyAborted, match=r"contact of the hull with the floor at .* s, x 0.00, y 0.00, z 0.1\d m"):
        for _ in range(100):
            body.step(DOWN, 0.1)
    time_s = body._time_s - body.state.left[0] / 120
    free.step(DOWN, time_s)
    np.testing.assert_allclose(free.world_from_body, body.world_from_body, atol=1e-12)


class Diver:
    def __init__(self, setup):
        self.n = 0

    def command(self, estimate, reference):
        return DOWN


@pytest.mark.long
@pytest.mark.parametrize("more", [[], SURROGATE])
def test_a_controller_that_dives_ends_the_survey_by_contact(tmp_path, more):
    plugin = [f"control.plugin={Diver.__module__}:Diver"]
    result = survey.run(load_scenario("reef", [*SMALL, *more, *plugin], allow_plugins=True), tmp_path, outputs=None)
    assert result.status == "aborted" and "contact of the hull with the floor at" in result.metrics["reason"]


@pytest.mark.long
def test_the_compiled_loop_ends_at_contact(tmp_path, monkeypatch):
    """The floor is raised into the path of the vehicle after the plan was checked."""
    found = surrogate_world.floor_of

    def raised(mission):
        floor = found(mission)
        return floor._replace(height_m=floor.height_m + 9, highest_m=floor.highest_m + 9)

    monkeypatch.setattr(surrogate_world, "floor_of", raised)
    result = survey.run(load_scenario("reef", [*SMALL, *SURROGATE]), tmp_path, outputs=None)
    assert result.status == "aborted" and "contact of the hull with the floor at 0.0" in result.metrics["reason"]


@pytest.mark.long
def test_a_stepped_world_ends_at_contact():
    world = twin.World(load_scenario("reef", SMALL))
    with world, pytest.raises(SurveyAborted, match="contact of the hull with the floor"):
        world.reset()
        while world.step(DOWN) is not None:
            pass
