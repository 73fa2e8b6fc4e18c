"""Objects in images: depth against ray casting in MuJoCo, normals, colours and levels of detail of the rasterizer."""

from __future__ import annotations

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import StereoRig
from twin.imaging.scene import object_view
from twin.imaging.scene.mesh_raster import DrawnMesh, ObjectView, Projection, Target, draw_meshes
from twin.imaging.scene.object_view import Objects, draw_over_floor
from twin.scenes.gl import mujoco
from twin.terrains.objects.coloured_mesh import Mesh, mesh_of
from twin.terrains.objects.placed_object import PlacedObject, model_of
from twin.terrains.objects.primitives import box, sphere
from twin.terrains.objects.shapes import SHAPES, build_shape

W, H, FOCAL = 160, 120, 150.0
RIG = StereoRig(W, H, FOCAL, 0.15, 30.0, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)))
PROJECTION = Projection(FOCAL, RIG.cx_px, RIG.cy_px, 0.05, True)
TILTED = geometry.pose(
    geometry.rotation_from_rpy(0.15, -0.1, 0.7) @ geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, 0, 1.6])
)


def placed(mesh: Mesh, x=0.0, y=0.0, z=0.0, scale=1.0) -> PlacedObject:
    pose = np.diag([scale, scale, scale, 1.0])
    pose[:3, 3] = x, y, z
    return PlacedObject(model_of(mesh), pose, scale, 0)


def drawn(items: list[PlacedObject], pose: np.ndarray, floor_m: float = np.inf):
    """Returns albedo, depth and view of objects over a background at a constant depth."""
    albedo, depth = np.zeros((H, W, 3), np.uint8), np.full((H, W), floor_m, np.float32)
    view = draw_over_floor(Objects(items), RIG, albedo, depth, pose, 0.0)
    return albedo, depth, view


def ray_depths(items: list[PlacedObject], pose: np.ndarray) -> np.ndarray:
    """Returns the depth (H, W) [m] of objects by `mj_ray`; inf where there is none."""
    spec = mujoco.MjSpec()
    for k, item in enumerate(items):
        mesh = item.model.levels[0].mesh
        added = spec.add_mesh(name=f"m{k}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
        vertices = mesh.vertices_m @ item.world_from_object[:3, :3].T + item.world_from_object[:3, 3]
        added.uservert, added.userface = vertices.ravel(), mesh.faces.ravel()
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_MESH, meshname=f"m{k}")
    model = spec.compile()
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    u, v = np.meshgrid(np.arange(W), np.arange(H))
    rays = np.stack([(u - RIG.cx_px) / FOCAL, (v - RIG.cy_px) / FOCAL, np.ones((H, W))], axis=-1)
    depth = np.full((H, W), np.inf)
    geom = np.zeros(1, np.int32)
    for row, col in np.ndindex(H, W):
        along = pose[:3, :3] @ rays[row, col]
        length = np.linalg.norm(along)
        distance = mujoco.mj_ray(model, data, pose[:3, 3], along / length, None, 1, -1, geom)
        depth[row, col] = distance / length if distance >= 0 else np.inf
    return depth


def test_depth_agrees_with_mj_ray_within_1_mm(monkeypatch):
    """At 99.9 % of the pixels; the rest are silhouettes, where a ray passes within rounding error of an edge."""
    monkeypatch.setattr(object_view, "LEVEL_PX", 0.0)  # the full meshes
    rng = np.random.default_rng(2)
    names = ("boulder", "branching_coral", "table_coral", "pipe")
    items = [placed(build_shape(name, None, rng), 0.6 * (k % 2) - 0.2, 0.5 * (k // 2) - 0.3, 0.0, 0.7)
             for k, name in enumerate(names)]  # fmt: skip
    depth, expected = drawn(items, TILTED)[1], ray_depths(items, TILTED)
    assert 0.15 < np.isfinite(expected).mean() < 0.9
    with np.errstate(invalid="ignore"):
        same = (np.isinf(depth) & np.isinf(expected)) | (np.abs(depth - expected) < 1e-3)
    assert same.mean() >= 0.999


def test_an_object_hides_the_floor_only_where_it_is_nearer():
    """A cube of 0.4 m side whose top is at depth 1.4: the top, at the image centre, is seen at its exact size."""
    cube = mesh_of(*box((0.4, 0.4, 0.4), (4, 4, 4)), (0.2, 0.6, 1.0))
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 1.8]))
    albedo, depth, view = drawn([placed(cube)], pose, 1.6)
    side = 0.2 / 1.4 * FOCAL
    inside = np.abs(np.arange(W) - (W - 1) / 2) < side
    rows = np.abs(np.arange(H) - (H - 1) / 2) < side
    np.testing.assert_array_equal(view.label > 0, rows[:, None] & inside)
    np.testing.assert_allclose(depth, np.where(view.label > 0, 1.4, 1.6), rtol=1e-6)
    assert (albedo[view.label > 0] == [51, 153, 255]).all() and (albedo[view.label == 0] == 0).all()
    assert not drawn([placed(cube)], pose, 1.3)[2].label.any()  # a floor above it hides it


def test_normals_of_a_sphere_are_its_radii():
    """The facets are tilted by less than 1.5 deg against the sphere, as their edges span up to 2.6 deg."""
    ball = placed(mesh_of(*sphere(), (1, 1, 1)), z=-0.5, scale=0.5)
    _, depth, view = drawn([ball], TILTED)
    u, v = np.meshgrid(np.arange(W) - RIG.cx_px, np.arange(H) - RIG.cy_px)
    seen = view.label > 0
    point = np.stack([u * depth / FOCAL, v * depth / FOCAL, depth], axis=-1)[seen]
    radius = (point - geometry.transform(np.linalg.inv(TILTED), np.zeros((1, 3)))[0]) / 0.5
    cosine = np.einsum("ij,ij->i", radius, view.normal[seen]) / np.linalg.norm(radius, axis=1)
    assert seen.sum() > 1000 and np.rad2deg(np.arccos(cosine.min())) < 1.5
    np.testing.assert_allclose(np.linalg.norm(view.normal[seen], axis=1), 1, rtol=1e-5)


def test_colours_are_interpolated_in_perspective():
    """On a slanted square, the albedo grows linearly with the position on the square, not in the image."""
    corners = np.array([[-0.4, -0.3, 0.0], [0.4, -0.3, 0.6], [0.4, 0.3, 0.6], [-0.4, 0.3, 0.0]])
    square = mesh_of(corners, [[0, 1, 2], [0, 2, 3]], np.repeat([[0.0], [1.0], [1.0], [0.0]], 3, axis=1))
    albedo, depth = np.zeros((H, W, 3), np.uint8), np.full((H, W), np.inf, np.float32)
    camera_from_world = np.linalg.inv(geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 1.6])))
    view = ObjectView(np.empty((H, W, 3), np.float32), np.zeros((H, W), np.uint16))
    draw_meshes([DrawnMesh(square, camera_from_world)], PROJECTION, Target(depth, albedo, *view))
    seen = np.isfinite(depth)
    height = 1.6 - depth[seen]
    assert seen.sum() > 5000
    np.testing.assert_allclose(albedo[seen][:, 0], 255 * height / 0.6, atol=0.51)


@pytest.mark.parametrize("name", SHAPES)
def test_levels_of_detail_deviate_by_less_than_their_cell(name):
    """Vertices lie within one cell's diagonal of the shape, and the levels become coarser.

    Where no part is thinner than a cell, the shape lies as near to the level, too.
    """
    from scipy.spatial import KDTree

    levels = model_of(build_shape(name, None, np.random.default_rng(0))).levels
    full = KDTree(levels[0].mesh.vertices_m)
    counts = [len(level.mesh.faces) for level in levels]
    assert counts == sorted(counts, reverse=True) and counts[-1] < counts[0] / 50
    for level in levels[1:]:
        assert full.query(level.mesh.vertices_m)[0].max() <= np.sqrt(3) * level.cell_m
        if name in ("boulder", "brain_coral", "crate"):
            used = level.mesh.vertices_m[np.unique(level.mesh.faces)]
            assert np.percentile(KDTree(used).query(levels[0].mesh.vertices_m)[0], 99) <= np.sqrt(3) * level.cell_m


def test_the_level_of_detail_changes_the_image_by_less_than_a_pixel(monkeypatch):
    """Depth of a boulder at a tenth of its triangles: the median error is below half a pixel, as cells span a pixel."""
    item = placed(build_shape("boulder", None, np.random.default_rng(1)), scale=0.35)
    coarse = drawn([item], TILTED)[1]
    monkeypatch.setattr(object_view, "LEVEL_PX", 0.0)
    fine = drawn([item], TILTED)[1]
    both = np.isfinite(coarse) & np.isfinite(fine)
    assert (np.isfinite(coarse) != np.isfinite(fine)).sum() < 0.05 * both.sum()
    assert not np.array_equal(coarse, fine) and np.median(np.abs(coarse[both] - fine[both])) < 0.5 * 1.4 / FOCAL
