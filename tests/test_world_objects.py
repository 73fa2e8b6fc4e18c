"""Objects of a mission: errors with file and line, true surface as seen from above, coverage below overhangs."""

from __future__ import annotations

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import MapGrid, StereoRig
from twin.errors import ScenarioError
from twin.scenario.file import dump_toml, load_scenario
from twin.terrains.objects.coloured_mesh import mesh_of
from twin.terrains.objects.placed_object import PlacedObject, model_of
from twin.terrains.objects.primitives import sphere
from twin.terrains.objects.shapes import build_shape
from twin.world.mission import prepare
from twin.world.observed_cells import Coverage
from twin.world.top_surface import TopSurface, top_surface, without_objects

GRID = MapGrid(-0.6, 0.5, 0.01, 100, 120)
FLOOR = np.full((100, 120), 0.2, np.float32)


def placed(mesh, position, scale=1.0):
    pose = np.diag([scale, scale, scale, 1.0])
    pose[:3, 3] = position
    return PlacedObject(model_of(mesh), pose, scale, 0)


def test_the_surface_of_a_ball_from_above_is_its_upper_half():
    """A ball of radius 0.3 centred 0.1 above the floor: facets of 2.6 deg lie at most 0.1 mm inside the sphere."""
    ball = placed(mesh_of(*sphere(), (1, 1, 1)), (0.1, -0.05, 0.0), 0.3)  # stands on z = 0, so its centre is at 0.3
    surface = top_surface(GRID, TopSurface(FLOOR), [ball])
    x, y = np.meshgrid(*GRID.centres())
    square = 0.09 - (x - 0.1) ** 2 - (y + 0.05) ** 2
    inside, outside = square > 0.001, square < -0.001
    np.testing.assert_allclose(surface.height_m[inside], 0.3 + np.sqrt(square[inside]), atol=3e-3)
    assert (surface.objects[inside] == 1).all() and not surface.objects[outside].any()
    assert (surface.height_m[outside] == np.float32(0.2)).all()
    # the underside is above the floor where 0.3 - sqrt(square) > 0.2 + OVERHANG_M, i.e. square < 0.09^2
    assert surface.overhung[inside & (square < 0.08**2)].all() and not surface.overhung[square > 0.1**2].any()


def test_blocks_of_rows_do_not_change_the_surface(monkeypatch):
    items = [placed(build_shape("table_coral", None, np.random.default_rng(0)), (0, 0, 0.1), 0.8)]
    whole = top_surface(GRID, TopSurface(FLOOR), items)
    monkeypatch.setattr("twin.world.top_surface._ROWS_PER_BLOCK", 7)
    for part, same in zip(top_surface(GRID, TopSurface(FLOOR), items), whole, strict=True):
        np.testing.assert_array_equal(part, same)
    assert whole.objects.any() and whole.overhung.any() and not whole.objects.all()


def test_floor_below_an_overhang_is_not_observed():
    """Cameras that see only the floor, at depth 1, mark the cells whose top is the floor, not those below a plate."""
    rig = StereoRig(160, 120, 150.0, 0.1, 30.0, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)))
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 1.2]))
    depth = np.ones((120, 160), np.float32)
    top = FLOOR.copy()
    top[40:60, 50:70] = 0.4
    bare, plate = Coverage(GRID, rig), Coverage(GRID, rig, top)
    for coverage in (bare, plate):
        coverage.add(pose, depth, depth)
    np.testing.assert_array_equal(plate.seen, bare.seen & (top < 0.3))
    assert bare.seen[40:60, 50:70].all()


SCENE = """extends = "reef.toml"
[[objects]]
shape = "boulder"
position_m = [0.5, 0.2]
size_m = 0.4

[[objects]]
{}
"""


def prepared(text, folder, name="scene.toml"):
    from twin.scenario.file import find_scene

    scene = SCENE.replace("reef.toml", str(find_scene("reef"))).format(text)
    (folder / name).write_text(scene)
    return prepare(load_scenario(folder / name, ["plan.area_m=[1.0, 0.5]", "terrain.texture_px_m=0.04"]))


@pytest.mark.parametrize(
    ("text", "line", "problem"),
    [
        ('shape = "mesh"\nposition_m = [0, 0]', 7, "objects.1.mesh_file: missing"),
        ('shape = "mesh"\nposition_m = [0, 0]\nmesh_file = "no.ply"', 10, "objects.1.mesh_file: no such file"),
        ('shape = "crate"', 7, "objects.1.position_m: missing (allowed: either position_m or per_m2)"),
        ('shape = "crate"\nposition_m = [0, 0]\nper_m2 = 1.0', 9, "objects.1.position_m: both are given"),
        ('shape = "crate"\nposition_m = [0, 0]\non = "sand"', 10, "objects.1.on: has no effect on an object"),
        ('shape = "crate"\nper_m2 = 1\nwidth_m = 0.1', 10, "objects.1.width_m: has no effect on shape 'crate'"),
        ('shape = "crate"\nposition_m = [40, 0]', 9, "objects.1.position_m: the object reaches beyond the terrain"),
        ('shape = "sponge"\nposition_m = [0, 0]\nsize_m = 2.5', 7, "objects.1: the object at x 0.00, y 0.00 is in"),
        ('shape = "sponge"\nposition_m = [0, 0]\nheight_m = 1.9', 7, "objects.1: the object at x 0.00, y 0.00 is in"),
    ],
)  # fmt: skip
def test_invalid_objects_are_one_line_with_file_and_line(text, line, problem, tmp_path):
    with pytest.raises(ScenarioError) as raised:
        prepared(text, tmp_path)
    assert len(raised.value.lines) == 1
    assert raised.value.lines[0].startswith(f"{tmp_path / 'scene.toml'}:{line}: {problem}")


def test_objects_survive_the_resolved_scenario_and_paths_are_relative_to_the_file(tmp_path):
    import trimesh

    trimesh.creation.box((0.3, 0.3, 0.1)).export(tmp_path / "box.ply")
    mission = prepared('shape = "mesh"\nmesh_file = "box.ply"\nposition_m = [-0.5, 0]\nheading_deg = 0', tmp_path)
    assert len(mission.objects) == 2
    np.testing.assert_allclose(np.ptp(mission.objects[1].corners_m(), axis=0), [0.3, 0.3, 0.1], atol=1e-6)
    (tmp_path / "resolved.toml").write_text(dump_toml(mission.scenario))
    again = prepare(load_scenario(tmp_path / "resolved.toml"))
    for item, same in zip(mission.objects, again.objects, strict=True):
        np.testing.assert_array_equal(item.world_from_object, same.world_from_object)


def test_the_true_albedo_is_unknown_where_an_object_covers_the_floor() -> None:
    map_grid, grid = MapGrid(-1.0, 1.0, 0.5, 4, 4), MapGrid(-1.0, 1.0, 0.25, 8, 8)
    objects = np.zeros((4, 4), np.uint16)
    objects[0, 3] = 1  # the north-east corner
    albedo = without_objects(np.ones((8, 8, 3), np.float32), grid, objects, map_grid)
    assert np.isnan(albedo[:2, 6:]).all() and np.isnan(albedo).sum() == 2 * 2 * 3
    assert without_objects(albedo, grid, None, map_grid) is albedo


REEF = """
seed = 1
[terrain]
kind = "reef"
size_m = [6.0, 5.0]
grid_m = 0.1
[imaging]
fidelity = "surrogate"
[plan]
area_m = [2.0, 1.0]
[[objects]]
shape = "boulder"
per_m2 = 0.3
area_m = [4.0, 3.0]
size_spread = 0.3
[[objects]]
shape = "crate"
position_m = [0.5, 0.2]
"""


def objects_of(folder, *overrides):
    (folder / "reef.toml").write_text(REEF)
    return prepare(load_scenario(folder / "reef.toml", overrides))


def test_objects_grow_about_their_base_or_are_gone_and_all_others_stay_where_they_are(tmp_path):
    before = objects_of(tmp_path).objects
    after = objects_of(
        tmp_path, "objects.0.growth_m=0.02", "objects.0.growing=[1]", "objects.0.removed=[2]", "seed=7", "scene_seed=1"
    ).objects
    boulders = [k for k, item in enumerate(before) if item.group == 0]
    grown, gone = boulders[1], boulders[2]
    assert len(boulders) >= 3 and before[boulders[0]].radius_m >= before[grown].radius_m
    assert len(after) == len(before) - 1
    for number, item in enumerate(before):
        if number == gone:
            continue
        same = after[number - (number > gone)]
        np.testing.assert_array_equal(same.world_from_object[:3, 3], item.world_from_object[:3, 3])
        rise_m = (same.scale - item.scale) * item.model.high_m[2]
        assert rise_m == pytest.approx(0.02 if number == grown else 0.0)


def test_two_surveys_of_one_scene_have_the_same_floor_and_objects(tmp_path):
    first, second = objects_of(tmp_path), objects_of(tmp_path, "seed=7", "scene_seed=1")
    np.testing.assert_array_equal(first.terrain.height_m, second.terrain.height_m)
    np.testing.assert_array_equal(first.terrain.texture, second.terrain.texture)
    other = objects_of(tmp_path, "seed=7")
    assert not np.array_equal(first.terrain.height_m, other.terrain.height_m)


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("objects.0.removed=[400]", r"objects.0.removed: 400: no such object .allowed: 0 to "),
        ("objects.1.growing=[0]", "objects.1.growing: has no effect without growth_m"),
        ("objects.1.growth_m=-3", r"objects.1.growth_m: -3: an object is 0.2 m high .allowed: more than -0.2"),
        ("objects.1.growth_m=20", "objects.1.growth_m: the object reaches beyond the terrain"),
        ("objects.0.removed=[-1]", "objects.0.removed.0: -1"),
    ],
)
def test_changes_of_objects_that_are_not_possible_are_refused(tmp_path, override, message):
    with pytest.raises(ScenarioError, match=message):
        objects_of(tmp_path, override)
