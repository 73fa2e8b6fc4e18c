"""A controller plug-in changes path and pace: smoothly, within limits, clear of the floor; its faults are named."""

import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import twin
from twin import survey
from twin.core.records import Frame, Readings
from twin.plugin.protocols import LEAST_PACE, MOST_OFFSET_M, Adaptation
from twin.session.path_adaptation import PluginAdaptation
from twin.world.floor_following import FloorFollower
from twin.world.mission import prepare
from twin.world.mission_flight import Flight

HEAD = ["terrain.size_m=[8.0, 6.0]", "plan.area_m=[2.0, 1.0]", "plan.tracks=1", "plan.altitude_m=1.8",
        "imaging.fidelity=surrogate", "imaging.extrapolate=true"]  # fmt: skip
MODULE = '''
import numpy as np

from twin.core import geometry
from twin.plugin.protocols import Adaptation


class Fixed:
    """Proportional-derivative control along the path as it is planned."""

    def __init__(self, setup):
        self.setup, self.seen = setup, []

    def command(self, estimate, reference):
        body = estimate.world_from_camera @ geometry.inverse(self.setup.rig.body_from_camera)
        twist = geometry.adjoint(self.setup.rig.body_from_camera) @ estimate.camera_velocity
        level = geometry.rotation_from_rpy(0.0, 0.0, float(reference.yaw))
        at = reference.position - level @ self.setup.rig.body_from_camera[:3, 3]
        error = geometry.log(geometry.inverse(body) @ geometry.pose(level, at))
        wanted = np.r_[np.zeros(3), body[:3, :3].T @ reference.velocity]
        wrench = self.setup.hull.inertia * (6.0 * error + 4.0 * (wanted - twist))
        return self.setup.allocation.commands(wrench)[0]


class Nothing(Fixed):
    def adapt(self, situation):
        return None


class Shifts(Fixed):
    situations = []

    def adapt(self, situation):
        self.situations.append(situation)
        situation.reference.position[:] = 1e9  # a copy
        return Adaptation((0.0, 0.2, 0.0), 0.5)


class Nan(Fixed):
    def adapt(self, situation):
        return Adaptation((0.0, np.nan, 0.0), 0.5)


class Tuple(Fixed):
    def adapt(self, situation):
        return (0.0, 0.2, 0.0), 0.5
'''


@pytest.fixture(scope="module", autouse=True)
def _module(tmp_path_factory):
    folder = tmp_path_factory.mktemp("package")
    (folder / "adaptive_package.py").write_text(MODULE)
    sys.path.insert(0, str(folder))
    yield
    sys.path.remove(str(folder))
    sys.modules.pop("adaptive_package", None)


def scenario(*overrides):
    return twin.load_scenario("reef", [*HEAD, *overrides], allow_plugins=True)


class EmptyWorld:
    """World that only counts frames and keeps their references."""

    def __init__(self):
        self.steps, self.act, self.start_sequence, self.end_sequence = [], *[lambda *_: None] * 3

    def observe(self, step):
        self.steps.append(step)
        return Frame(len(self) - 1, (len(self) - 1) / 30.0, None, None, Readings(), step.keyframe)

    def __len__(self):
        return len(self.steps)


class Asks:
    """Pilot that asks for one adaptation at every keyframe."""

    adapts = True

    def __init__(self, *asked):
        self.asked = Adaptation(*asked)

    def adaptation(self, situation):
        return self.asked


def flown(mission, *asked):
    """Returns position and velocity (n, 3) of the reference, and the number of frames, of a flight without vehicle."""
    world = EmptyWorld()
    flight = Flight(mission, world)
    plugin = PluginAdaptation(flight, Asks(*asked), None)
    frame = flight.start()
    while frame is not None and not flight.holding:
        plugin.adapt(frame, None, None)
        frame = flight.step(None)
    parts = [
        np.array([getattr(step.reference, name) for step in world.steps]) for name in world.steps[0].reference._fields
    ]
    return SimpleNamespace(**dict(zip(world.steps[0].reference._fields, parts, strict=True)), n=len(world.steps))


@pytest.fixture(scope="module")
def mission():
    return prepare(scenario())


def test_a_path_without_an_adaptation_is_the_planned_one(mission):
    planned = mission.plan.all_references()
    np.testing.assert_array_equal(flown(mission, np.zeros(3)).position[:-1], planned.position)


def test_offset_and_pace_change_without_a_step_and_are_reached(mission):
    found, planned, dt = flown(mission, np.array([0.1, 0.2, -0.1]), 0.5), mission.plan.all_references(), 1 / 30
    moved = found.position[-1] - planned.position[-1]
    np.testing.assert_allclose(moved, [0.1, 0.2, -0.1], atol=0.01)
    steps = np.diff(found.position, axis=0)
    np.testing.assert_allclose(steps / dt, (found.velocity[1:] + found.velocity[:-1]) / 2, atol=0.01)
    assert np.linalg.norm(np.diff(found.velocity, axis=0), axis=1).max() < 0.5 * dt  # accelerations below 0.5 m/s2
    assert found.n > 1.7 * len(planned.position) and np.abs(found.velocity[:, 0]).max() < 0.75 * mission.plan.speed_mps


def test_offset_and_pace_are_limited(mission):
    chart = mission.chart
    found = flown(mission, np.array([0.0, 3.0, 9.0]), -4.0)
    y, z = found.position[-1, 1:] - mission.plan.all_references().position[-1, 1:]
    assert np.hypot(0.0, y) == pytest.approx(MOST_OFFSET_M, abs=0.01) and z == pytest.approx(MOST_OFFSET_M, abs=0.01)
    assert found.n < 1.1 * len(mission.plan.all_references().position) / LEAST_PACE
    beside = prepare(scenario("plan.centre_m=[0.0,2.4]", "plan.tracks=0"))  # its last leg keeps within the floor
    edge, planned_y = flown(beside, np.array([0.0, 3.0, 0.0])).position, beside.plan.waypoints(1)[:, 1]
    room_m = chart.north_m - beside.plan.outline()[:, 1].max()
    assert edge[-1, 1] - planned_y[-1] == pytest.approx(room_m, abs=0.01) and room_m < 0.3


def test_a_path_is_not_lowered_or_shifted_into_the_floor(mission):
    low = prepare(scenario("plan.altitude_m=1.4", "plan.clearance_m=0.9"))
    heights, path = low.chart.height_near, low.plan.all_references().position
    for asked in ([0.0, 0.0, -0.5], [0.5, 0.0, -0.5], [0.0, -0.5, -0.2]):
        found = flown(low, np.array(asked)).position
        around = found[:, None, :2] + 0.4 * np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=-1)
        assert (found[:, 2:] - heights(around[..., 0], around[..., 1])).min() >= 0.9 - 1e-6
    assert found[:, 2].min() >= path[:, 2].min() - 0.5


def test_a_path_is_not_shifted_towards_a_wall():
    """0.9 m beside a path over the floor, a wall rises to its height; it has to be clear within 0.7 m."""
    mission = prepare(scenario("plan.height=floor"))
    _, y, z = mission.plan.all_references().position.T
    heights, floor = mission.chart.height_m.copy(), mission.chart
    heights[floor.south_m + np.arange(len(heights)) * floor.spacing_m > y.max() + 0.9] = z.max()
    walled = replace(mission, chart=replace(floor, height_m=heights))
    near, far = (flown(m, np.array([0.0, 0.5, 0.0])).position[-1, 1] for m in (walled, mission))
    assert near == pytest.approx(y[-1], abs=1e-9) and far == pytest.approx(y[-1] + 0.5, abs=0.01)


def test_the_floor_so_far_is_the_mean_of_its_points():
    follower = FloorFollower(prepare(scenario()))
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-1, 1, (20_000, 2)), rng.normal(0.7, 0.1, 20_000)])
    follower.add(points)
    found = follower.floor_m
    assert len(found) > 100 and np.abs(found[:, :2]).max() < 1.2
    # of about 50 points in a cell, with the relief of the chart within it
    assert np.median(np.abs(found[:, 2] - 0.7)) < 0.02


ANGLES = np.linspace(0, 2 * np.pi, 16)


@pytest.mark.long
def test_a_plugin_shifts_the_path_by_its_offset_and_halves_the_pace(tmp_path):
    plain = survey.run(scenario("control.plugin=adaptive_package:Fixed"), tmp_path / "plain", outputs=())
    found = survey.run(scenario("control.plugin=adaptive_package:Shifts"), tmp_path / "found", outputs=())
    assert plain.status == "complete" and found.status == "complete", found.metrics["reason"]
    before, after = (np.loadtxt(r.folder / "trajectory_truth.tum") for r in (plain, found))
    assert after[-1, 2] - before[-1, 2] == pytest.approx(0.2, abs=0.04)
    assert 1.6 < after[-1, 0] / before[-1, 0] < 2.1
    assert found.metrics["control"]["cross_track_rmse_m"] < 0.05
    last = sys.modules["adaptive_package"].Shifts.situations[-1]
    floor = prepare(scenario()).terrain.height_near(*last.floor_m[:, :2].T)
    assert len(last.floor_m) > 100 and last.readings.pressure_z_m is not None
    assert np.median(np.abs(last.floor_m[:, 2] - floor)) < 0.03


@pytest.mark.long
def test_a_plugin_that_asks_for_nothing_flies_the_bytes_of_one_without_the_method(tmp_path):
    runs = [survey.run(scenario(f"control.plugin=adaptive_package:{name}"), tmp_path / name, outputs=())
            for name in ("Fixed", "Nothing")]  # fmt: skip
    for name in ("truth", "online", "final", "reference"):
        one, other = ((run.folder / f"trajectory_{name}.tum").read_bytes() for run in runs)
        assert one == other, name


@pytest.mark.long
@pytest.mark.parametrize(("name", "reason"), [
    ("Nan", "adapt returned 1 of 3 numbers that are not finite (expected: finite numbers)"),
    ("Tuple", "adapt returned tuple (expected: an Adaptation or None)"),
])  # fmt: skip
def test_an_unusable_adaptation_ends_the_survey_with_its_name(tmp_path, name, reason):
    found = survey.run(scenario(f"control.plugin=adaptive_package:{name}"), tmp_path / "run", outputs=None)
    assert found.status == "aborted" and found.metrics["reason"].startswith(f"control.plugin adaptive_package:{name}: ")
    assert found.metrics["reason"].endswith(reason)
