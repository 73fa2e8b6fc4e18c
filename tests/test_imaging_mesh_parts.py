"""Parts of meshes and the rasterizer that leaves parts out, against a plain loop over triangles and pixels."""

from __future__ import annotations

import numpy as np
import pytest

from twin.core import geometry, threads
from twin.imaging.scene import mesh_raster
from twin.imaging.scene.mesh_raster import DrawnMesh, Projection, Target, draw_meshes
from twin.imaging.scene.object_view import swayed
from twin.terrains.objects.coloured_mesh import Mesh, mesh_of
from twin.terrains.objects.detail import PART_FACES, UNKNOWN, Parts, parts_of
from twin.terrains.objects.placed_object import PlacedObject, model_of
from twin.terrains.objects.primitives import box
from twin.terrains.objects.shapes import SHAPES, build_shape

W, H = 96, 80
FAR = 1_000_000  #: beyond all images [px]
PERSPECTIVE = Projection(90.0, 47.5, 39.5, 0.05, True)
PARALLEL = Projection(60.0, 47.5, 39.5, -np.inf, False)


def images(depth_m: float = np.inf) -> Target:
    depth, uv = np.full((H, W), depth_m, np.float32), np.zeros((H, W, 3), np.float32)
    return Target(
        depth, np.zeros((H, W, 3), np.uint8), np.zeros((H, W, 3), np.float32), np.zeros((H, W), np.uint16), uv
    )


def random_views(n: int) -> list[np.ndarray]:
    """Returns maps camera_from_object (3, 4) with any rotation; the object is partly outside the image in most."""
    rng = np.random.default_rng(4)
    views = []
    for _ in range(n):
        turn = geometry.so3_exp(rng.uniform(-2, 2, 3)) * rng.uniform(0.3, 1.2)
        views.append(np.column_stack([turn, [*rng.uniform(-0.6, 0.6, 2), rng.uniform(0.4, 2.0)]]))
    return views


def inside_out(mesh: Mesh) -> Mesh:
    return mesh._replace(faces=np.ascontiguousarray(mesh.faces[:, ::-1]))


def plant() -> Mesh:
    kelp = model_of(build_shape("kelp", None, np.random.default_rng(1)), sways=True)
    return swayed(kelp.levels[2].mesh, PlacedObject(kelp, np.eye(4), 1.0, 0), np.array([0.4, 0.2, 0.0]), 1.3)


def soup() -> Mesh:
    """Returns 300 triangles of all sizes that intersect each other, some of them slivers or points."""
    rng = np.random.default_rng(3)
    corners = rng.uniform(-0.5, 0.5, (300, 1, 3)) + rng.normal(size=(300, 3, 3)) * rng.choice([0.01, 0.3], (300, 1, 1))
    corners[:20, 2] = corners[:20, 1]
    corners[20:40, 2] = corners[20:40, 1] + 1e-7
    return mesh_of(corners.reshape(-1, 3), np.arange(900).reshape(-1, 3), rng.uniform(0, 1, (900, 3)))


MESHES = {name: build_shape(name, None, np.random.default_rng(0)) for name in ("boulder", "branching_coral", "crate")}
MESHES |= {"inside out": inside_out(MESHES["boulder"]), "plant": plant(), "soup": soup()}


def plainly_drawn(item: DrawnMesh, projection: Projection, target: Target) -> None:
    """Draws triangle by triangle, each over the pixel centres in its bounding rectangle."""
    focal, cx, cy, near, perspective = projection
    m = item.camera_from_object
    a, b, c = item.mesh.vertices_m.astype(np.float64).T
    x, y, z = (m[k, 0] * a + m[k, 1] * b + m[k, 2] * c + m[k, 3] for k in range(3))
    q = 1 / z if perspective else np.ones_like(z)
    u, v, q = focal * x * q + cx, focal * y * q + cy, q if perspective else -z
    for f in item.mesh.faces:
        (ua, ub, uc), (va, vb, vc), (qa, qb, qc) = u[f], v[f], q[f]
        area = (ub - ua) * (vc - va) - (uc - ua) * (vb - va)
        if (z[f] < near).any() or area == 0 or (item.closed and area > 0):
            continue
        across = np.arange(max(np.ceil(u[f].min()), 0), min(np.floor(u[f].max()), W - 1) + 1)
        down = np.arange(max(np.ceil(v[f].min()), 0), min(np.floor(v[f].max()), H - 1) + 1)
        col, row = np.meshgrid(across, down)
        wb = ((col - ua) * (vc - va) - (uc - ua) * (row - va)) * (1 / area)
        wc = ((ub - ua) * (row - va) - (col - ua) * (vb - va)) * (1 / area)
        wa = 1 - wb - wc
        mixed = wa * qa + wb * qb + wc * qc
        with np.errstate(divide="ignore"):
            depth = (1 / mixed if perspective else -mixed).astype(np.float32)
        rows, cols = row.astype(int), col.astype(int)
        drawn = (wa >= 0) & (wb >= 0) & (wc >= 0) & (depth < target.depth[rows, cols])
        rows, cols = rows[drawn], cols[drawn]
        target.depth[rows, cols] = depth[drawn]
        shares = (wa * qa / mixed, wb * qb / mixed, wc * qc / mixed) if perspective else (wa, wb, wc)
        share = np.stack(shares, axis=-1)[drawn]
        colours = item.mesh.colours[f].astype(np.float64)
        assert target.albedo is not None and target.label is not None
        mixed = share[:, :1] * colours[0] + share[:, 1:2] * colours[1] + share[:, 2:] * colours[2]
        target.albedo[rows, cols] = mixed + 0.5
        target.label[rows, cols] = item.label


@pytest.mark.parametrize("projection", (PERSPECTIVE, pytest.param(PARALLEL, marks=pytest.mark.long)))
@pytest.mark.parametrize("name", MESHES)
def test_an_image_is_that_of_all_triangles_one_by_one(name: str, projection: Projection) -> None:
    """To the last bit, over a floor that hides a part of the mesh, whether or not back faces are drawn."""
    mesh = MESHES[name]
    mesh = mesh._replace(faces=mesh.faces[:: 1 + len(mesh.faces) // 2000])
    shows = 0
    for k, view in enumerate(random_views(4)):
        item = DrawnMesh(mesh, view, 7, k % 2 == 0, parts_of(mesh))
        drawn, expected = images(1.7), images(1.7)
        draw_meshes([item], projection, drawn)
        plainly_drawn(item, projection, expected)
        for layer in ("depth", "label", "albedo"):
            np.testing.assert_array_equal(getattr(drawn, layer), getattr(expected, layer), err_msg=layer)
        shows += np.count_nonzero(drawn.label)
    assert shows > 50


@pytest.mark.parametrize("projection", (PERSPECTIVE, PARALLEL))
@pytest.mark.parametrize("name", MESHES)
def test_bounds_do_not_change_the_image(name: str, projection: Projection) -> None:
    """Of whole meshes, drawn as closed or not, also inside out and mirrored; with all layers."""
    mesh, shows = MESHES[name], 0
    uv = mesh.vertices_m
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    for k, view in enumerate(random_views(20)):
        view = view @ mirror if k % 5 == 0 else view
        item = DrawnMesh(mesh, view, 3, k % 2 == 0, parts_of(mesh), uv)
        drawn, expected = images(), images()
        draw_meshes([item], projection, drawn)
        draw_meshes([item._replace(parts=UNKNOWN)], projection, expected)
        for layer, same in zip(drawn, expected, strict=True):
            np.testing.assert_array_equal(layer, same)
        shows += np.count_nonzero(drawn.label)
    assert shows > 1000


def shown_parts(mesh: Mesh, view: np.ndarray, window: tuple[int, int, int, int] = (0, W, 0, H)) -> set[int]:
    """Returns the numbers of the parts of a closed mesh that are drawn in a window: columns and rows, first and end."""
    shown = np.empty(-(-len(mesh.faces) // PART_FACES), np.int32)
    n = mesh_raster._list_parts(parts_of(mesh), np.ascontiguousarray(view), PERSPECTIVE, window, True, shown)
    return set(shown[:n].tolist())


def test_parts_that_face_away_or_lie_outside_the_image_are_left_out() -> None:
    """Of a cube of 24 parts, seen from in front of one side: five sides face away, and so do their parts.

    The side is centred, so half of its parts lie in each half of the image.
    """
    cube = mesh_of(*box((1.0, 1.0, 1.0), (16, 16, 16)), (1, 1, 1))
    assert len(cube.faces) == 24 * PART_FACES
    view = np.column_stack([np.eye(3), [0.0, 0.0, 2.0]])
    shown = shown_parts(cube, view)
    z_of_part = cube.vertices_m[cube.faces][..., 2].reshape(24, -1)
    assert shown == set(np.flatnonzero((z_of_part == -0.5).all(axis=1)).tolist()) and len(shown) == 4
    halves = [shown_parts(cube, view, (*cols, 0, H)) for cols in ((0, W // 2 - 1), (W // 2 + 1, W))]
    assert halves[0] | halves[1] == shown and not halves[0] & halves[1]
    aside = view.copy()
    aside[0, 3] = 2.0
    assert not shown_parts(cube, aside)


def test_all_triangles_of_a_part_that_is_left_out_face_away_or_are_too_near() -> None:
    """Bowls and domes of one part each, from near their surface, where the directions to its corners differ most."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, 9), np.linspace(-0.5, 0.5, 9))
    n = np.arange(8)[:, None] * 9 + np.arange(8)
    faces = np.stack([n, n + 1, n + 10, n, n + 10, n + 9], axis=-1).reshape(-1, 3)
    rng, left_out, is_seen = np.random.default_rng(6), 0, 0
    for _ in range(3000):
        sheet = mesh_of(
            np.stack([x, y, rng.uniform(-0.6, 0.6) * (x**2 + y**2)], axis=-1).reshape(-1, 3), faces, (1, 1, 1)
        )
        view = np.column_stack([geometry.so3_exp(rng.uniform(-3, 3, 3)), rng.uniform(-0.3, 0.3, 3)])
        a, b, c = np.moveaxis((sheet.vertices_m @ view[:, :3].T + view[:, 3])[sheet.faces], 1, 0)
        facing = np.einsum("ij,ij->i", np.cross(b - a, c - a), a) < 0
        seen = facing & (np.stack([a, b, c])[..., 2].min(axis=0) >= PERSPECTIVE.near_m)
        if not shown_parts(sheet, view, (-FAR, FAR, -FAR, FAR)):
            left_out += 1
            assert not seen.any()
        is_seen += bool(seen.any())
    assert left_out > 300 and is_seen > 1000


@pytest.mark.parametrize("name", [*SHAPES, "soup"])
def test_the_bounds_of_a_part_contain_its_corners_and_normals(name: str) -> None:
    mesh = MESHES["soup"] if name == "soup" else build_shape(name, None, np.random.default_rng(2))
    parts: Parts = parts_of(mesh)
    corners = mesh.vertices_m[mesh.faces].astype(np.float64)
    part = np.arange(len(corners)) // PART_FACES
    from_centre = corners - parts.centre_m[part][:, None]
    assert (np.abs(from_centre) <= parts.half_m[part][:, None] * (1 + 1e-12) + 1e-12).all()
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-300)
    coned = np.isfinite(parts.behind_m[part])
    assert coned.any() or name in ("soup", "branching_coral")  # each part of a branch goes all around it
    assert (np.einsum("ij,ij->i", normal, parts.axis[part])[coned] >= parts.cos_sin[part, 0][coned] - 1e-12).all()
    in_front = np.einsum("ij,ikj->ik", normal, from_centre).min(axis=1)
    assert (in_front[coned] >= -parts.behind_m[part][coned] - 1e-9).all()


def test_the_image_does_not_depend_on_the_number_of_threads(monkeypatch) -> None:
    """Large and small triangles, on both sides of the border between the bands."""
    items = [DrawnMesh(MESHES[name], random_views(9)[k], k + 1) for k, name in enumerate(MESHES)]
    drawn = []
    for processors in (1, 2):
        monkeypatch.setattr(threads, "_n_processors", lambda n=processors: n)
        drawn.append(images())
        draw_meshes(items, PERSPECTIVE, drawn[-1])
    for one, two in zip(*drawn, strict=True):
        np.testing.assert_array_equal(one, two)
    assert len(np.unique(drawn[0].label)) > 4
