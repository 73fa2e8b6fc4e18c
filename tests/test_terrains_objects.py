"""Objects on a floor: mesh files, placement and the errors of bad input."""

from __future__ import annotations

import functools
import struct
from typing import get_args

import numpy as np
import pytest
import trimesh

from twin import terrains
from twin.errors import TwinError
from twin.scenario.model import ObjectConfig, Scenario, TerrainConfig
from twin.terrains import Terrain
from twin.terrains.ground_cover import COVERS
from twin.terrains.objects import mesh_file, scattering
from twin.terrains.objects.coloured_mesh import Mesh, with_colours
from twin.terrains.objects.detail import levels_of
from twin.terrains.objects.floor_mesh import tiles_of
from twin.terrains.objects.mesh_file import face_count
from twin.terrains.objects.placed_object import PlacedObject, grown, model_of
from twin.terrains.objects.shapes import SHAPES, build_shape
from twin.world import objects
from twin.world.objects import load_objects

FIELD = "objects.0.mesh_file"
CUBE = trimesh.creation.box((2.0, 1.0, 0.5))


@functools.cache
def reef():
    """Returns a floor with relief, 8 m x 6 m."""
    return terrains.generate("reef", (8.0, 6.0), 1.2, 0.0, 0.04, terrains.TextureSource(0.2), 5)


PLANE = terrains.Terrain(np.zeros((9, 13), np.float32), 0.5, -3.0, -2.0, np.zeros((4, 4, 3), np.uint8), 1.0)


def read(file, **options):
    return mesh_file.read_mesh(file, FIELD, (0.4, 0.4, 0.4), **options)


@pytest.mark.parametrize("suffix", ["ply", "obj", "glb"])
def test_a_mesh_file_keeps_its_triangles_and_vertex_colours(suffix, tmp_path):
    cube = CUBE.copy()
    cube.visual.vertex_colors = np.arange(32, dtype=np.uint8).reshape(8, 4) * 7
    cube.export(tmp_path / f"cube.{suffix}")
    mesh = read(tmp_path / f"cube.{suffix}")
    assert face_count(tmp_path / f"cube.{suffix}") == len(mesh.faces) == 12
    np.testing.assert_allclose(np.ptp(mesh.vertices_m, axis=0), [2.0, 1.0, 0.5], rtol=1e-6)
    order = np.lexsort(mesh.vertices_m.T), np.lexsort(cube.vertices.T)
    np.testing.assert_array_equal(mesh.colours[order[0]], cube.visual.vertex_colors[order[1], :3])


def test_a_glb_mesh_counts_once_for_each_node_that_places_it(tmp_path):
    scene = trimesh.Scene()
    scene.add_geometry(CUBE, geom_name="cube")
    for k in (1, 2):
        shift = trimesh.transformations.translation_matrix([3 * k, 0, 0])
        scene.graph.update(frame_to=f"cube {k}", geometry="cube", matrix=shift)
    scene.export(tmp_path / "cubes.glb")
    assert face_count(tmp_path / "cubes.glb") == len(read(tmp_path / "cubes.glb").faces) == 36


def test_the_triangles_of_a_textured_file_are_limited_however_many_parts_it_has(tmp_path):
    scene = trimesh.Scene([textured_square(shift_m) for shift_m in (0.0, 3.0, 6.0)])
    scene.export(tmp_path / "squares.glb")
    mesh = read(tmp_path / "squares.glb")
    assert mesh_file.TEXTURED_FACES / 5 < len(mesh.faces) <= mesh_file.TEXTURED_FACES


def textured_square(shift_m=0.0):
    """Returns a square with a texture whose red and blue increase to the east, and its green to the north, over 2 m."""
    from PIL import Image

    east = np.tile(np.linspace(0, 255, 256).astype(np.uint8), (256, 1))
    ramp = np.stack([east, east.T[::-1], east], axis=2)
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]], float) + [shift_m, 0, 0]
    uv = np.array([[0.001, 0.001], [0.999, 0.001], [0.999, 0.999], [0.001, 0.999]])
    visual = trimesh.visual.TextureVisuals(uv, image=Image.fromarray(ramp))
    return trimesh.Trimesh(corners, [[0, 1, 2], [0, 2, 3]], visual=visual, process=False)


def test_a_texture_becomes_the_colours_of_the_vertices(tmp_path):
    textured_square().export(tmp_path / "square.glb")
    mesh = read(tmp_path / "square.glb")
    assert mesh_file.TEXTURED_FACES / 4 < len(mesh.faces) <= mesh_file.TEXTURED_FACES
    assert np.abs(mesh.colours[:, :2] - (mesh.vertices_m[:, :2] + 1) / 2 * 255).max() < 2


def test_corners_of_no_triangle_do_not_count(tmp_path):
    """As a cropped scan keeps them."""
    stray = trimesh.Trimesh([*CUBE.vertices, [30.0, 0.0, -10.0]], CUBE.faces, process=False)
    stray.visual.vertex_colors = np.tile([10, 20, 30, 255], (9, 1))
    stray.export(tmp_path / "stray.ply")
    mesh = read(tmp_path / "stray.ply")
    np.testing.assert_allclose(np.ptp(mesh.vertices_m, axis=0), [2.0, 1.0, 0.5], atol=1e-6)
    assert len(mesh.colours) == 8
    floor = mesh_file.read_textured_mesh(tmp_path / "stray.ply", FIELD)
    assert len(floor.uv) == len(floor.mesh.vertices_m) == 8


def test_the_edges_of_a_texture_have_the_colours_of_their_own_side():
    image = np.zeros((10, 20, 3), np.uint8)
    image[:5, :10], image[5:, 10:] = [255, 0, 0], [0, 0, 255]  # v points up
    uv = np.array([[0.0, 1.0], [1.0, 0.0], [1.0, 1.0], [2.25, -0.75], [-0.25, 0.25]])
    found = mesh_file._sampled(image, uv)
    np.testing.assert_array_equal(found, [[255, 0, 0], [0, 0, 255], [0, 0, 0], [0, 0, 0], [0, 0, 255]])


def test_the_colour_of_an_obj_material_is_its_colour_without_a_texture(tmp_path):
    (tmp_path / "a.mtl").write_text("newmtl red\nKd 0.9 0.1 0.1\n")
    corners = "".join(f"v {x} {y} {z}\n" for x, y, z in CUBE.vertices)
    faces = "".join(f"f {a + 1} {b + 1} {c + 1}\n" for a, b, c in CUBE.faces)
    (tmp_path / "a.obj").write_text(f"mtllib a.mtl\n{corners}usemtl red\n{faces}")
    for mesh in (read(tmp_path / "a.obj"), mesh_file.read_textured_mesh(tmp_path / "a.obj", FIELD).mesh):
        np.testing.assert_allclose(mesh.colours, np.tile([230, 25, 25], (len(mesh.colours), 1)), atol=1)


def test_a_flat_object_does_not_grow(tmp_path):
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], [[0, 1, 2], [0, 2, 3]])
    with pytest.raises(TwinError, match="growth_m: 0.1: an object is 0 m high"):
        grown(PlacedObject(model_of(with_colours(flat.vertices, flat.faces, 100)), np.eye(4), 1.0, 0), 0.1, "growth_m")


def material_box(factor, texture=None):
    """Returns a box with a glTF material."""
    from PIL import Image

    image = None if texture is None else Image.fromarray(np.full((4, 4, 3), texture, np.uint8))
    box = CUBE.copy()
    material = trimesh.visual.material.PBRMaterial(baseColorFactor=factor, baseColorTexture=image)
    box.visual = trimesh.visual.TextureVisuals(None if image is None else np.zeros((8, 2)), material)
    return box


@pytest.mark.parametrize(("texture", "expected"), [(None, [255, 128, 0]), (100, [100, 100, 100])])
def test_the_base_colour_of_a_glb_material_is_its_colour_without_a_texture(tmp_path, texture, expected):
    material_box([255, 128, 0, 255], texture).export(tmp_path / "box.glb")
    np.testing.assert_array_equal(np.unique(read(tmp_path / "box.glb").colours, axis=0), [expected])
    floor = mesh_file.read_textured_mesh(tmp_path / "box.glb", FIELD)
    shown = floor.mesh.colours if texture is None else floor.images[0].reshape(-1, 3)
    np.testing.assert_array_equal(np.unique(shown, axis=0), [expected])


@pytest.mark.parametrize("turned", [False, True])
def test_triangles_that_a_file_lists_twice_count_once(turned, tmp_path):
    ball = trimesh.creation.icosphere(1)
    again = ball.faces[:5, ::-1] if turned else ball.faces[:5]
    trimesh.Trimesh(ball.vertices, np.vstack([ball.faces, again]), process=False).export(tmp_path / "ball.ply")
    np.testing.assert_array_equal(read(tmp_path / "ball.ply").faces, ball.faces)


def test_a_mesh_in_coordinates_of_a_map_projection_keeps_its_shape(tmp_path):
    """Single precision rounds a northing of 5000 km to 0.5 m."""
    fine = CUBE.subdivide().subdivide()
    far = fine.copy()
    far.vertices = fine.vertices + [500_000.0, 5_000_000.0, -20.0]
    far.export(tmp_path / "far.obj", digits=6)
    found = read(tmp_path / "far.obj").vertices_m.astype(float)
    assert np.abs(found - found.mean(axis=0) - fine.vertices + fine.vertices.mean(axis=0)).max() < 1e-5


def ply_header(n_faces):
    return f"ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nelement face {n_faces}\nend_header\n".encode()


def broken(name, folder):
    """Returns a file that is not a valid mesh."""
    contents = {
        "huge.ply": ply_header(10**8), "text.ply": b"not a mesh", "points.ply": b"ply\nelement vertex 3\nend_header\n",
        "cut.ply": CUBE.export(file_type="ply")[:400], "empty.obj": b"v 0 0 0\n", "empty.ply": b"",
        "broken.glb": b"glTF" + struct.pack("<III", 2, 40, 20) + b"JSON" + b"{" * 20, "mesh.stl": b"solid",
        "dot.obj": b"v 1 1 1\nv 1 1 1\nv 1 1 1\nf 1 2 3\n", "nan.obj": b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n",
        "fan.obj": b"v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nv 0 -1 0\nf 1 2 3\nf 1 2 4\nf 1 2 5\n",
    }  # fmt: skip
    if name in contents:
        (folder / name).write_bytes(contents[name])
    return folder / name


@pytest.mark.parametrize(
    ("name", "problem"),
    [
        ("missing.ply", "no such file"),
        ("huge.ply", "has 100000000 triangles"),
        ("text.ply", "has no PLY header"),
        ("empty.ply", "has no PLY header"),
        ("points.ply", "is a point cloud without faces"),
        ("cut.ply", "cannot be read"),
        ("empty.obj", "has no triangles"),
        ("broken.glb", "has an invalid description"),
        ("mesh.stl", "is not a mesh file"),
        ("dot.obj", "has no extent"),
        ("nan.obj", "not finite"),
        ("fan.obj", "is not manifold: 1 edges belong to more than two triangles"),
    ],
)
def test_a_bad_mesh_file_is_one_clear_error(name, problem, tmp_path):
    with pytest.raises(TwinError, match=problem) as raised:
        read(broken(name, tmp_path))
    assert raised.value.field == FIELD and "\n" not in str(raised.value)


@pytest.mark.parametrize("name", SHAPES)
def test_built_in_shapes_are_manifold_of_size_one_and_seeded(name):
    """Closed shapes enclose a positive volume, so their triangles face outwards; kelp is a sheet."""
    mesh, again, other = (build_shape(name, None, np.random.default_rng(seed)) for seed in (1, 1, 2))
    np.testing.assert_array_equal(mesh.vertices_m, again.vertices_m)
    assert not np.array_equal(mesh.colours, other.colours)
    assert mesh_file.crowded_edges(mesh) == 0 and 0.8 < np.ptp(mesh.vertices_m, axis=0).max() < 1.3
    solid = trimesh.Trimesh(mesh.vertices_m, mesh.faces)
    assert (solid.is_watertight and solid.volume > 0) or name == "kelp"


CONE = model_of(with_colours(*(lambda c: (c.vertices, c.faces, np.full((len(c.vertices), 3), 99)))(
    trimesh.creation.cone(0.5, 1.0))))  # fmt: skip


def scattered(seed=1, taken=(), **keys):
    config = ObjectConfig(shape="boulder", **({"per_m2": 1.0, "size_m": 0.3} | keys))
    return scattering.place(2, config, [CONE], reef(), taken, seed)


def test_scattered_objects_have_the_density_and_do_not_overlap():
    items = scattered(size_spread=0.4)
    centres = np.array([item.world_from_object[:2, 3] for item in items])
    radii = np.array([item.scale for item in items]) * np.hypot(*(CONE.high_m - CONE.low_m)[:2]) / 2
    gaps = np.hypot(*(centres[:, None] - centres).T) - radii - radii[:, None]
    assert len(items) == 48 and gaps[~np.eye(48, dtype=bool)].min() >= 0


def test_spacing_is_a_poisson_disc():
    centres = np.array([item.world_from_object[:2, 3] for item in scattered(spacing_m=0.7)])
    apart = np.hypot(*(centres[:, None] - centres).T)[~np.eye(len(centres), dtype=bool)]
    assert apart.min() >= 0.7 and np.median(np.abs(centres), axis=0).min() > 1


def test_sizes_are_log_normal():
    sizes = np.array([item.scale for item in scattered(per_m2=10.0, size_m=0.1, size_spread=0.3)])
    assert len(sizes) == 480
    logs = np.log(sizes / 0.1)
    assert abs(logs.mean()) < 3 * 0.3 / np.sqrt(480) and 0.24 < logs.std() < 0.3  # a cut at 2 sigma takes 4 %
    assert np.abs(logs).max() <= 0.6 + 1e-9


def test_the_slope_of_a_plane_is_its_angle_whatever_the_reach():
    nodes_m = np.arange(41) * 0.1 - 2.0
    height_m = np.tan(np.deg2rad(20.0)) * (0.6 * nodes_m + 0.8 * nodes_m[:, None])
    plane = Terrain(height_m.astype(np.float32), 0.1, -2.0, -2.0, np.zeros((2, 2, 3), np.uint8), 2.0)
    for reach_m in (0.1, 0.35):
        np.testing.assert_allclose(scattering.slope_deg(plane, np.zeros(1), np.ones(1), reach_m), 20.0, rtol=1e-4)


@pytest.mark.parametrize(("ground", "steep"), [("sand", False), ("slopes", True)])
def test_scattered_objects_stand_on_their_ground(ground, steep):
    for item in scattered(on=ground):
        x, y = item.world_from_object[:2, 3, None]
        reach_m = 0.3 / np.sqrt(2) / 2
        assert (scattering.slope_deg(reef(), x, y, reach_m)[0] >= scattering.STEEP_DEG) == steep


def test_placement_is_seeded():
    first, same, other = (poses_of(items) for items in (scattered(), scattered(), scattered(seed=2)))
    np.testing.assert_array_equal(first, same)
    assert not np.array_equal(first, other)


def poses_of(items):
    return np.array([item.world_from_object for item in items])


@pytest.mark.long
def test_objects_of_an_entry_stand_in_the_same_places_whatever_other_entries_there_are(tmp_path):
    """Entries stand in two areas that do not overlap; the later entry is changed, and an entry is added after both."""
    west = {"shape": "crate", "per_m2": 0.5, "size_m": 0.2, "area_m": [2.0, 4.0], "centre_m": [-2.5, 0.0]}
    east = west | {"shape": "pipe", "centre_m": [2.5, 0.0]}

    def placed(*entries):
        scenario = Scenario.model_validate({"seed": 5, "objects": entries})
        return [poses_of([i for i in load_objects(scenario, reef(), lambda build: build()) if i.group == k])
                for k in range(len(entries))]  # fmt: skip

    both, denser = placed(west, east), placed(west, east | {"per_m2": 1.0})
    more = placed(west, east, east | {"size_m": 0.1})
    np.testing.assert_array_equal(both[0], denser[0])
    assert len(denser[1]) == 2 * len(both[1])
    np.testing.assert_array_equal(both[0], more[0])
    np.testing.assert_array_equal(both[1], more[1])
    np.testing.assert_array_equal(placed(west | {"per_m2": 1.0}, east)[1], both[1])


def test_the_shapes_and_covers_of_scenarios_are_those_that_can_be_built():
    assert set(get_args(ObjectConfig.model_fields["shape"].annotation)) == {*SHAPES, "mesh"}
    covers = get_args(TerrainConfig.model_fields["cover"].annotation)[0]
    assert set(get_args(covers)) == set(COVERS)


def test_objects_are_sunk_and_perpendicular_to_the_floor():
    config = ObjectConfig(shape="boulder", position_m=(0.0, 0.0), size_m=0.4, sunk=0.25)
    item = scattering.place(0, config, [CONE], PLANE, [], 1)[0]
    np.testing.assert_allclose(item.corners_m()[:, 2].min(), -0.1, atol=1e-6)
    floor = terrains.Terrain(
        np.tile(np.linspace(0, 2, 21, dtype=np.float32), (21, 1)), 0.2, -2.0, -2.0, np.zeros((4, 4, 3), np.uint8), 1.0
    )
    tilted = scattering.place(0, config.model_copy(update={"upright": False}), [CONE], floor, [], 1)[0]
    axis = tilted.world_from_object[:3, 2] / tilted.scale
    np.testing.assert_allclose(axis, np.array([-0.5, 0, 1]) / np.sqrt(1.25), atol=1e-6)
    np.testing.assert_allclose(tilted.world_from_object[:3, 3], [0, 0, 1] - 0.1 * axis, atol=1e-6)


@pytest.mark.parametrize(
    ("keys", "field", "problem"),
    [
        ({"per_m2": None, "position_m": (3.95, 0.0)}, "objects.2.position_m", "reaches beyond the terrain"),
        ({"per_m2": None, "position_m": (30.0, 0.0)}, "objects.2.position_m", "reaches beyond the terrain"),
        ({"per_m2": 9.0, "size_m": 0.8}, "objects.2.per_m2", r"only \d+ of 432 objects fit without overlap"),
        ({"per_m2": 900.0}, "objects.2.per_m2", "43200 objects"),
        ({"per_m2": 0.001}, "objects.2.per_m2", "no object on 48.00 m2"),
        ({"area_m": (1.0, 1.0), "centre_m": (50.0, 0.0)}, "objects.2.per_m2", "no object on 0.00 m2"),
        ({"size_m": 12.0}, "objects.2.per_m2", "only 0 of 48 objects fit"),
    ],
)
def test_objects_that_do_not_fit_are_errors(keys, field, problem):
    with pytest.raises(TwinError, match=problem) as raised:
        scattered(**keys)
    assert raised.value.field == field


@pytest.mark.parametrize("missing", ["square.mtl", "reef.png", "square.ply"])
def test_a_file_that_a_mesh_names_and_is_not_there_is_an_error_that_names_it(missing, tmp_path):
    """The mesh would be grey; `square.ply` stands for a texture file that is no image."""
    (tmp_path / "square.mtl").write_text("newmtl reef\nmap_Kd reef.png\n")
    mesh = "mtllib square.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl reef\nf 1/1 2/2 3/3\n"
    (tmp_path / "square.obj").write_text(mesh)
    (tmp_path / "reef.png").write_bytes(b"no image")
    named = "reef.png" if missing == "square.ply" else missing
    if missing != "square.ply":
        (tmp_path / missing).unlink()
    for load in (read, lambda file: mesh_file.read_textured_mesh(file, FIELD)):
        with pytest.raises(TwinError, match=f"'square.obj' needs the file '{named}'"):
            load(tmp_path / "square.obj")


def test_a_grey_texture_of_16_bits_keeps_its_brightness(tmp_path):
    """30000 of 65535 is 117 of 255; Pillow's conversion to RGB gives 255."""
    from PIL import Image

    image = Image.fromarray(np.full((4, 6), 30000, np.uint16))
    assert image.mode == "I;16"
    for one in (image, image.convert("I")):
        np.testing.assert_array_equal(mesh_file._rgb(one), np.full((4, 6, 3), 117))
    image.save(tmp_path / "grey.png")
    (tmp_path / "square.mtl").write_text("newmtl grey\nmap_Kd grey.png\n")
    (tmp_path / "square.obj").write_text(
        "mtllib square.mtl\nv 0 0 0\nv 1 0 0\nv 1 1 0\nvt 0 0\nvt 1 0\nvt 1 1\nusemtl grey\nf 1/1 2/2 3/3\n"
    )
    assert (mesh_file.read_textured_mesh(tmp_path / "square.obj", FIELD).images[0] == 117).all()
    assert (read(tmp_path / "square.obj").colours == 117).all()


@pytest.mark.parametrize("near_m", [0.0, 1e-30])
def test_degenerate_triangles_do_not_change_the_levels_of_detail(near_m):
    """1005 triangles with an edge length of 0 or almost 0 beside two with edges of 2 cm and 2.8 cm."""
    corners = np.array([[0, 0, 0], [0.02, 0, 0], [0.02, 0.02, 0], [0, 0.02, 0], [0, 0, near_m]], np.float32)
    real = np.array([[0, 1, 2], [0, 2, 3]], np.int32)
    colours = np.arange(15, dtype=np.uint8).reshape(5, 3)
    mesh = Mesh(corners, np.concatenate([real, np.tile(np.int32([0, 0, 4]), (1005, 1))]), colours)
    sides_m = [
        [level.cell_m for level in tiles_of(untextured(one)).tiles[0].placed.model.levels]
        for one in (mesh, mesh._replace(faces=real))
    ]
    assert sides_m[0] == sides_m[1] and sides_m[0][:2] == pytest.approx([0, 0.02])
    assert [(level.cell_m, len(level.mesh.faces)) for level in levels_of(mesh)] == [(0, 1007), (pytest.approx(0.02), 2)]


def untextured(mesh: Mesh) -> mesh_file.TexturedMesh:
    """Returns a mesh whose triangles have no texture."""
    uv, texture = np.zeros((len(mesh.vertices_m), 2), np.float32), np.full(len(mesh.faces), -1, np.int32)
    return mesh_file.TexturedMesh(mesh, uv, texture, ())


def test_a_model_read_from_disk_is_the_built_one_and_a_damaged_file_is_built_again(tmp_path, monkeypatch):
    monkeypatch.setattr(objects, "cache_folder", lambda *_: tmp_path)
    seed = np.random.SeedSequence([3, 4])
    expected = model_of(build_shape("crate", None, np.random.default_rng(seed)))
    for damaged in (None, b"", b"no pickle"):
        if damaged is not None:
            next(tmp_path.glob("*.pickle")).write_bytes(damaged)
        for _ in range(2):  # built, then read
            model = objects.built_model("crate", None, seed)
            for level, of_built in zip(model.levels, expected.levels, strict=True):
                np.testing.assert_array_equal(level.mesh.vertices_m, of_built.mesh.vertices_m)
                assert level.mesh.vertices_m.flags.f_contiguous
    assert len(list(tmp_path.iterdir())) == 1
    objects.built_model("crate", (0.1, 0.2, 0.3), seed)
    assert len(list(tmp_path.iterdir())) == 2
