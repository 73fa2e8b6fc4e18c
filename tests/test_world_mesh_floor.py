"""A mesh as the whole floor: depth against ray casting, truth, height grids, textures, objects on it, bad files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh
from PIL import Image

from twin import survey, terrains
from twin.core import geometry
from twin.core.height_field import grid_triangles
from twin.core.records import MapGrid, StereoRig
from twin.errors import ScenarioError, TwinError
from twin.imaging.scene.object_view import Objects, draw_over_floor
from twin.scenario.file import find_scene, load_scenario
from twin.scenes.gl import mujoco
from twin.surrogate import matchability
from twin.terrains.objects import mesh_file
from twin.terrains.objects.coloured_mesh import Mesh, joined
from twin.terrains.objects.floor_mesh import divided, levelled, tiles_of
from twin.terrains.objects.mesh_file import TexturedMesh
from twin.world import mesh_floor, top_surface
from twin.world.mesh_floor import floor_surface
from twin.world.mission import Mission, prepare
from twin.world.top_surface import true_albedo, true_heights

W, H, FOCAL = 160, 120, 130.0
RIG = StereoRig(W, H, FOCAL, 0.15, 30.0, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)))
GRID = MapGrid(-1.2, 0.9, 0.02, 90, 120)
Y_UP = trimesh.transformations.rotation_matrix(-np.pi / 2, [1, 0, 0])
PLATE_M = (0.1, 0.2, 0.5)  #: centre of the upper side of the plate of `table`
SURVEY = [
    "rig.image_width_px=192", "rig.image_height_px=144", "rig.frame_rate_hz=15", "terrain.texture_px_m=0.005",
    "plan.area_m=[0.8, 0.5]", "plan.altitude_m=1.8", "control.hold_s=0.4",
]  # fmt: skip
REEF = terrains.generate("reef", (4.0, 3.2), 0.3, 0.0, 0.05, terrains.TextureSource(0.01), 5)


def sheet(floor: terrains.Terrain = REEF) -> trimesh.Trimesh:
    """Returns a height grid with its texture as a mesh."""
    ny, nx = floor.height_m.shape
    x, y = np.meshgrid(floor.west_m + floor.spacing_m * np.arange(nx), floor.south_m + floor.spacing_m * np.arange(ny))
    uv = np.stack([(x - floor.west_m) / floor.size_m[0], (y - floor.south_m) / floor.size_m[1]], axis=-1)
    visual = trimesh.visual.TextureVisuals(uv.reshape(-1, 2), image=Image.fromarray(floor.texture))
    points = np.stack([x, y, floor.height_m], axis=-1).reshape(-1, 3)
    return trimesh.Trimesh(points, grid_triangles(np.arange(ny * nx).reshape(ny, nx)), visual=visual, process=False)


def box(low: tuple[float, ...], high: tuple[float, ...]) -> trimesh.Trimesh:
    """Returns a box between two corners, with the colours of its vertices."""
    part = trimesh.creation.box(bounds=np.array([low, high]))
    part.visual.vertex_colors = [200, 90, 60, 255]
    return part


def table() -> trimesh.Scene:
    """Returns a floor with relief, a plate of 0.8 m x 0.6 m on a leg that reaches into the floor, and a buried box."""
    x, y, top = PLATE_M
    plate = box((x - 0.4, y - 0.3, top - 0.04), (x + 0.4, y + 0.3, top))
    buried = box((-1.0, -0.7, -0.3), (-0.7, -0.4, -0.1))
    return trimesh.Scene([sheet(), plate, buried, box((x - 0.05, y - 0.05, -0.3), (x + 0.05, y + 0.05, top - 0.01))])


def mission_of(folder: Path, *overrides: str, file: str = "floor.obj", text: str = "") -> Mission:
    """Returns the mission of a small survey over the mesh `file` in a folder."""
    scene = f'extends = "{find_scene("reef")}"\n[terrain]\nkind = "mesh"\nmesh_file = "{file}"\n{text}\n'
    (folder / "scene.toml").write_text(scene)
    small = ["plan.area_m=[1.0, 0.5]", "terrain.texture_px_m=0.01", "map.cell_m=0.02"]
    return prepare(load_scenario(folder / "scene.toml", [*small, *overrides]))


def exported(scene: trimesh.Scene | trimesh.Trimesh, folder: Path, name: str = "floor.obj") -> Path:
    if name.endswith(".glb"):
        scene = trimesh.Scene(scene) if isinstance(scene, trimesh.Trimesh) else scene
        scene.apply_transform(Y_UP)
    scene.export(folder / name)
    return folder


@pytest.fixture(scope="module")
def tabled(tmp_path_factory: pytest.TempPathFactory) -> Mission:
    return mission_of(exported(table(), tmp_path_factory.mktemp("table"), "floor.glb"), file="floor.glb")


def looking(eye: tuple[float, ...], at: tuple[float, ...]) -> np.ndarray:
    """Returns the pose (4, 4) of an upright camera at `eye` that looks at `at`."""
    z = np.subtract(at, eye) / np.linalg.norm(np.subtract(at, eye))
    x = np.cross(z, [0, 0, 1]) / np.linalg.norm(np.cross(z, [0, 0, 1]))
    return geometry.pose(np.column_stack([x, np.cross(z, x), z]), np.array(eye))


def ray_depths(meshes: list[Mesh], pose: np.ndarray) -> np.ndarray:
    """Returns the depth (H, W) of meshes by MuJoCo's ray casting; inf where there is nothing."""
    mesh, spec = joined(meshes), mujoco.MjSpec()
    asset = spec.add_mesh(name="floor", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    asset.uservert = mesh.vertices_m.ravel()
    asset.userface = np.concatenate([mesh.faces, mesh.faces[:, ::-1]]).ravel()  # a ray meets front faces only
    spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname="floor")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    cols, rows = np.meshgrid((np.arange(W) - RIG.cx_px) / FOCAL, (np.arange(H) - RIG.cy_px) / FOCAL)
    rays = np.stack([cols, rows, np.ones_like(cols)], axis=-1).reshape(-1, 3)
    world = rays @ pose[:3, :3].T
    depth = np.array(
        [mujoco.mj_ray(model, data, pose[:3, 3], ray, None, 1, -1, np.zeros(1, np.int32)) for ray in world]
    )
    return np.where(depth < 0, np.inf, depth).reshape(H, W)


def test_the_depth_of_a_mesh_floor_is_that_of_ray_casting_also_below_an_overhang(tabled):
    assert tabled.mesh_floor is not None
    tiles = tabled.mesh_floor.tiles
    pose = looking((0.1, -1.1, 0.35), (0.1, 0.2, 0.33))  # below the upper side of the plate
    albedo, depth = np.zeros((H, W, 3), np.uint8), np.full((H, W), np.inf, np.float32)
    view = draw_over_floor(Objects((), floor=tiles), RIG, albedo, depth, pose, 0.0)
    expected = ray_depths([tile.placed.model.levels[0].mesh for tile in tiles.tiles], pose)
    both = np.isfinite(depth) & np.isfinite(expected)
    assert (np.isfinite(depth) == np.isfinite(expected)).mean() > 0.999
    assert (np.abs(depth[both] - expected[both]) < 1e-3).mean() > 0.999
    points = geometry.transform(pose, ray_points(depth)[both])
    below = (np.abs(points[:, :2] - PLATE_M[:2]) < [0.38, 0.28]).all(axis=1) & (points[:, 2] < PLATE_M[2] - 0.05)
    assert below.sum() > 100  # floor, leg and lower side of the plate are seen below it
    assert np.array_equal(view.label > 0, np.isfinite(depth))
    textured = np.array([False, *(tile.texture >= 0 for tile in tiles.tiles)])[view.label]
    np.testing.assert_array_equal((albedo == [200, 90, 60]).all(axis=2), (view.label > 0) & ~textured)


def ray_points(depth: np.ndarray) -> np.ndarray:
    cols, rows = np.meshgrid((np.arange(W) - RIG.cx_px) / FOCAL, (np.arange(H) - RIG.cy_px) / FOCAL)
    return np.stack([cols * depth, rows * depth, depth], axis=-1)


def test_a_height_grid_as_a_mesh_has_the_same_truth(tmp_path, monkeypatch):
    """The zero of the height is the lowest node of a grid that is finer by 3 %, which adds an offset below 1 mm."""
    monkeypatch.setattr(top_surface, "_ROWS_PER_BLOCK", 100)
    mission = mission_of(exported(sheet(), tmp_path))
    assert mission.mesh_floor is not None and mission.terrain.n_filled == 0
    surface, expected = floor_surface(mission.mesh_floor, GRID), true_heights(GRID, REEF.height_at)
    assert np.abs(surface.height_m - expected).max() < 1e-3 and not surface.overhung.any()
    # height grid: a node lies up to half a spacing from the nodes of the mesh, where slopes change
    assert np.percentile(np.abs(true_heights(GRID, mission.terrain.height_at) - expected), 99) < 0.01
    difference = np.abs(true_albedo(mission.terrain, GRID) - true_albedo(REEF, GRID))
    assert difference.mean() < 0.1 * true_albedo(REEF, GRID).std()
    x, y = np.random.default_rng(0).uniform([-1.9, -1.5], [1.9, 1.5], (5000, 2)).T
    assert (mission.mesh_floor.under.height_at(x, y) < REEF.height_at(x, y)).all()


def test_the_top_of_an_overhang_is_the_truth_and_the_floor_below_it_is_overhung(tabled):
    assert tabled.mesh_floor is not None
    surface, lowest_m = floor_surface(tabled.mesh_floor, GRID), REEF.height_m.min()
    x, y = np.meshgrid(*GRID.centres())
    beside = np.maximum(np.abs(x - PLATE_M[0]) / 0.4, np.abs(y - PLATE_M[1]) / 0.3)
    leg = np.maximum(np.abs(x - PLATE_M[0]), np.abs(y - PLATE_M[1])) < 0.05
    np.testing.assert_allclose(surface.height_m[beside < 0.99], PLATE_M[2] - lowest_m, atol=1e-3)
    np.testing.assert_array_equal(surface.overhung[~leg], (beside < 1)[~leg])  # not above the buried box
    np.testing.assert_allclose(surface.height_m[beside > 1], (REEF.height_at(x, y) - lowest_m)[beside > 1], atol=1e-3)
    assert tabled.terrain.height_at(*PLATE_M[:2]) == pytest.approx(PLATE_M[2] - lowest_m, abs=1e-3)


def test_the_cameras_keep_clear_of_an_overhang(tmp_path):
    exported(table(), tmp_path, "floor.glb")
    with pytest.raises(ScenarioError, match=r"plan.altitude_m: 0.7: the cameras come within 0\.\d+ m of the floor"):
        mission_of(tmp_path, "plan.altitude_m=0.7", "plan.overlap_reference=plane", file="floor.glb")


def test_objects_stand_on_the_highest_surface_and_the_floor_is_no_obstacle(tmp_path):
    x, y, top = PLATE_M
    text = f'[[objects]]\nshape = "sea_star"\nposition_m = [{x}, {y}]\nsize_m = 0.1\nsunk = 0.0\n'
    text += '[[objects]]\nshape = "sea_star"\nper_m2 = 2.0\nsize_m = 0.1\n'
    mission = mission_of(exported(table(), tmp_path, "floor.glb"), file="floor.glb", text=text)
    base_m = mission.objects[0].corners_m()[:, 2].min()
    assert base_m == pytest.approx(top - REEF.height_m.min(), abs=2e-3)
    area_m2 = np.prod(mission.terrain.size_m)
    assert len(mission.objects) == 1 + round(2.0 * area_m2)
    drawn = mission.rendered_objects()
    assert drawn is not None and mission.mesh_floor is not None
    tiles = mission.mesh_floor.tiles.tiles
    assert len(drawn.placed) == len(mission.objects) + len(tiles) and drawn.surface is not None
    labels = [-1] * (1 + len(mission.objects)) + [tile.texture for tile in tiles]  # the floor is labelled after objects
    np.testing.assert_array_equal(drawn.surface[1], labels)
    assert [uv is not None for uv in drawn.uv] == [texture >= 0 for texture in labels[1:]]


def test_the_surrogate_sees_the_texture_of_the_mesh(tabled):
    texture, texel_m = matchability._texture(tabled.scenario, tabled.terrain, 1.0)
    assert texture is tabled.terrain.texture and texel_m == tabled.terrain.texture_px_m


def test_a_floor_upside_down_in_millimetres_with_y_up_is_the_same_floor(tmp_path):
    expected = mission_of(exported(sheet(), tmp_path)).terrain
    turned = sheet()
    turned.faces = turned.faces[:, ::-1]
    turned.apply_scale(1000.0)
    turned.apply_transform(Y_UP)
    turned.export(tmp_path / "turned.obj")
    keys = "terrain.mesh_scale=0.001", "terrain.mesh_up=y"
    terrain = mission_of(tmp_path, *keys, file="turned.obj").terrain
    assert terrain.spacing_m == pytest.approx(expected.spacing_m, rel=1e-4)
    np.testing.assert_allclose(terrain.height_m, expected.height_m, atol=1e-4)
    assert np.abs(terrain.texture.astype(int) - expected.texture).mean() < 1.0


def test_a_texture_is_sampled_at_each_pixel_and_filtered_where_pixels_are_larger_than_texels():
    """Two triangles carry a board with fields of 8 texels: fields when near, the mean grey from afar."""
    fields = (np.indices((256, 256)) // 8).sum(axis=0) % 2
    board = np.repeat((fields * 200 + 20).astype(np.uint8)[..., None], 3, axis=2)
    square = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], np.float32)
    faces = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    uv = np.array([[0, 0], [1, 0], [1, 1], [0, 1]], np.float32)
    mesh = Mesh(square, faces, np.full((4, 3), 255, np.uint8))
    tiles = tiles_of(levelled(TexturedMesh(mesh, uv, np.zeros(2, np.int32), (board,)), 1.0))
    for pose, tolerance in ((ABOVE, 0), (looking((0.0, -0.6, 0.6), (0.0, 0.1, 0.0)), 40)):
        near = seen_from(tiles, pose)
        rays = ray_points(np.ones((H, W))) @ pose[:3, :3].T
        x, y, _ = np.moveaxis(pose[:3, 3] - rays * pose[2, 3] / rays[..., 2:], -1, 0)
        right, down = (x + 1) * 128, (1 - y) * 128  # texels from the north-west corner
        inside = (np.abs(right % 8 - 4) < 2) & (np.abs(down % 8 - 4) < 2) & (np.maximum(np.abs(x), np.abs(y)) < 0.9)
        expected = board[down[inside].astype(int), right[inside].astype(int), 0].astype(int)
        assert inside.sum() > 500 and np.abs(near[inside][:, 0] - expected).max() <= tolerance
    far = seen_from(tiles, geometry.pose(ABOVE[:3, :3], np.array([0, 0, 60.0])))
    assert abs(int(far[H // 2, W // 2, 0]) - 120) <= 2


def test_large_triangles_are_divided_without_cracks_or_change_of_shape(tmp_path):
    """Next to the edge of one large triangle lies a finer strip; all are divided, and a camera that looks along the
    floor, behind which most of it lies, sees floor in its whole lower half."""
    corners = np.array([[-3, -3, 0], [3, -3, 0], [3, 3, 1], [-3, 3, 1], [0, -3, 0]], np.float32)
    faces = np.array([[0, 4, 3], [4, 1, 2], [4, 2, 3]], np.int32)
    uv = ((corners[:, :2] + 3) / 6).astype(np.float32)
    whole = TexturedMesh(Mesh(corners, faces, np.full((5, 3), 9, np.uint8)), uv, np.zeros(3, np.int32), (REEF.texture,))
    fine = divided(whole)
    sides = fine.mesh.vertices_m[fine.mesh.faces]
    assert np.linalg.norm(sides - np.roll(sides, 1, axis=1), axis=2).max() <= 0.5
    assert area(fine.mesh) == pytest.approx(area(whole.mesh), rel=1e-6)
    np.testing.assert_allclose(fine.uv, (fine.mesh.vertices_m[:, :2] + 3) / 6, atol=1e-6)
    welded = np.sort(np.stack([fine.mesh.faces, np.roll(fine.mesh.faces, -1, axis=1)], axis=2), axis=2).reshape(-1, 2)
    ends, count = np.unique(welded, axis=0, return_counts=True)
    outline = fine.mesh.vertices_m[ends[count == 1]].mean(axis=1)  # edges of one triangle lie on the outline only
    assert np.allclose(np.abs(outline[:, :2]).max(axis=1), 3)
    albedo, depth = np.zeros((H, W, 3), np.uint8), np.full((H, W), np.inf, np.float32)
    pose = looking((0.0, -2.0, 0.8), (0.0, -1.0, 0.8))
    draw_over_floor(Objects((), floor=tiles_of(fine)), RIG, albedo, depth, pose, 0.0)
    assert np.isfinite(depth[H // 2 + 10 :]).all()


def area(mesh: Mesh) -> float:
    a, b, c = np.moveaxis(mesh.vertices_m[mesh.faces].astype(np.float64), 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


ABOVE = geometry.pose(np.diag([1.0, -1.0, -1.0]), np.array([0, 0, 0.5]))


def seen_from(tiles, pose: np.ndarray) -> np.ndarray:
    """Returns the albedo (H, W, 3) of tiles seen by a camera."""
    albedo, depth = np.zeros((H, W, 3), np.uint8), np.full((H, W), np.inf, np.float32)
    draw_over_floor(Objects((), floor=tiles), RIG, albedo, depth, pose, 0.0)
    return albedo


def test_holes_have_the_height_of_the_nearest_node(tmp_path):
    mesh = sheet()
    centres = mesh.triangles_center
    mesh.update_faces(np.abs(centres[:, :2]).max(axis=1) > 0.2)
    mission = mission_of(exported(mesh, tmp_path))
    assert mission.mesh_floor is not None and mission.terrain.n_filled > 20
    surface = floor_surface(mission.mesh_floor, GRID)
    x, y = np.meshgrid(*GRID.centres())
    hole = np.maximum(np.abs(x), np.abs(y)) < 0.15
    around = REEF.height_at(x, y)[np.maximum(np.abs(x), np.abs(y)) < 0.35]
    assert surface.height_m[hole].min() > around.min() - 0.1 and surface.height_m[hole].max() < around.max()
    assert mission.terrain.in_hole(x, y)[hole].all() and not mission.asked(x, y)[hole].any()


def bad_meshes(folder: Path) -> None:
    """Writes meshes that cannot be floors."""
    grey = trimesh.Trimesh(sheet().vertices, sheet().faces, process=False)
    grey.export(folder / "grey.ply")
    small = box((-0.2, -0.2, 0.0), (0.2, 0.2, 0.1))
    small.export(folder / "small.ply")
    wall = trimesh.Trimesh(
        [[-2, 0, 0], [2, 0.3, 0], [2, 0.3, 1], [-2, 0, 1]], [[0, 1, 2], [0, 2, 3]], process=False,
        vertex_colors=np.full((4, 4), 200, np.uint8),
    )  # fmt: skip
    wall.export(folder / "wall.ply")
    sheet().export(folder / "large.obj")
    (folder / "empty.ply").write_bytes(b"")
    head = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z"
    )
    huge = f"{head}\nelement face 100000000\nproperty list uchar int vertex_indices\nend_header\n"
    (folder / "huge.ply").write_text(huge)
    lost = box((-2.0, -2.0, 0.0), (2.0, 2.0, 0.1))
    lost.vertices[3] = np.nan
    lost.export(folder / "nan.ply")


@pytest.mark.parametrize(
    ("file", "overrides", "problem"),
    [
        ("no.ply", [], "terrain.mesh_file: no such file"),
        ("empty.ply", [], "terrain.mesh_file: 'empty.ply' cannot be read: has no PLY header"),
        ("huge.ply", [], "terrain.mesh_file: 'huge.ply' has 100000000 triangles (allowed: at most 2000000 triangles)"),
        ("nan.ply", [], "terrain.mesh_file: 'nan.ply' has corners that are not finite"),
        ("grey.ply", [], "terrain.mesh_file: 'grey.ply' has no colours"),
        (
            "large.obj",
            [],
            "terrain.mesh_file: 'large.obj' cannot be read: a texture is a PNG of 400 x 320 pixels",
        ),
        ("wall.ply", [], "terrain.mesh_file: 'wall.ply' has no surface that faces up"),
        ("small.ply", [], "plan.area_m: 1 x 0.5 m is larger than the terrain"),
        ("small.ply", ["terrain.mesh_scale=0.001"], "terrain.mesh_file: 'small.ply' covers 0.0004 m x 0.0004 m"),
        ("small.ply", ["terrain.cover=sand"], "terrain.cover: has no effect on a mesh"),
        ("small.ply", ["terrain.wall_texture=draped"], "terrain.wall_texture: has no effect on a mesh"),
        ("small.ply", ["terrain.kind=reef"], "terrain.mesh_file: has no effect on terrain.kind = 'reef'"),
    ],
)
def test_a_mesh_that_cannot_be_a_floor_is_one_clear_error(file, overrides, problem, tmp_path, monkeypatch):
    bad_meshes(tmp_path)
    monkeypatch.setattr(mesh_file, "MAX_TEXELS", 100_000)
    with pytest.raises(ScenarioError) as raised:
        mission_of(tmp_path, *overrides, file=file)
    assert len(raised.value.lines) == 1 and problem in raised.value.lines[0], raised.value.lines


def test_the_tiling_of_a_photo_has_no_effect_on_a_mesh_and_is_an_error(tmp_path):
    with pytest.raises(ScenarioError, match=r"terrain\.texture_tiling: has no effect without a photo"):
        mission_of(exported(sheet(), tmp_path), "terrain.texture_tiling=repeat")


@pytest.mark.parametrize(
    ("overrides", "unit"), [([], "assumed: it names none"), (["terrain.mesh_scale=1.0"], "terrain.mesh_scale")]
)
def test_the_statement_of_a_mesh_says_whether_its_unit_was_assumed(overrides, unit, tmp_path):
    mission = mission_of(exported(sheet(), tmp_path), *overrides)
    stated = mission.stated_input
    assert (stated["unit_evidence"], stated["crs"], stated["texture"]) == (unit, "", "1 textures of the mesh")
    assert stated["greatest"] - stated["least"] == pytest.approx(np.ptp(REEF.height_m), abs=1e-6)


def test_slivers_are_not_divided_without_bound(monkeypatch):
    monkeypatch.setattr("twin.terrains.objects.floor_mesh.MAX_DIVIDED", 300)
    corners = np.array([[0, 0, 0], [40, 0, 0], [0, 0.01, 0]], np.float32)
    sliver = Mesh(corners, np.array([[0, 1, 2]], np.int32), np.zeros((3, 3), np.uint8))
    whole = TexturedMesh(sliver, np.zeros((3, 2), np.float32), np.full(1, -1, np.int32), ())
    with pytest.raises(TwinError, match=r"terrain.mesh_file: 'a.ply' has long triangles .* more than 300"):
        mesh_floor._divided(whole, Path("a.ply"))
    huge = whole._replace(mesh=sliver._replace(vertices_m=np.full_like(corners, np.inf)))
    with pytest.raises(TwinError, match="'a.ply' is too large"):
        mesh_floor._divided(huge, Path("a.ply"))


@pytest.mark.slow
def test_a_survey_over_a_mesh_is_as_accurate_as_over_the_height_grid_it_was_exported_from(tmp_path, monkeypatch):
    """Both surveys have the same plan, seeds and texture; only the renderer of the floor differs.

    Images differ by about a grey level (docs/findings.md), so the errors of the matches differ. Measured: position
    errors (final) of 1.01 and 0.86 mm, LE90 of 7.3 and 6.9 mm (6 %). The limits are three to six times these
    differences.
    """
    reef = terrains.generate("reef", (4.0, 3.2), 0.3, 0.0, 0.05, terrains.TextureSource(0.005), 5)
    lowered = replace(reef, height_m=reef.height_m - reef.height_m.min())
    exported(sheet(reef), tmp_path)
    text = f'extends = "{find_scene("reef")}"\n[terrain]\nkind = "mesh"\nmesh_file = "floor.obj"\n'
    (tmp_path / "scene.toml").write_text(text)
    scenario = load_scenario(tmp_path / "scene.toml", SURVEY)
    found = {"mesh": survey.run(scenario, tmp_path / "mesh", outputs=None).metrics}
    monkeypatch.setattr("twin.world.mission.load_terrain", lambda _: lowered)
    found["grid"] = survey.run(load_scenario("reef", SURVEY), tmp_path / "grid", outputs=None).metrics
    mesh, grid = (found[kind] for kind in ("mesh", "grid"))
    assert mesh["status"] == grid["status"] == "complete"
    paths = [m["trajectory"]["final"]["ate_rmse_m"] for m in (mesh, grid)]
    assert max(paths) < 3e-3 and abs(paths[0] - paths[1]) < 1e-3
    assert mesh["map"]["le90_m"] == pytest.approx(grid["map"]["le90_m"], rel=0.2)
    assert mesh["map"]["completeness"] == pytest.approx(grid["map"]["completeness"], abs=0.01)
