"""Oblique picture of the map: colours, framing, and no picture if rendering fails."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import ElevationMap, MapGrid
from twin.exchange import mesh
from twin.report import mesh_picture
from twin.report.survey_page import write_report

pytestmark = pytest.mark.long

GRID = MapGrid(-2.0, 1.5, 0.05, 60, 80)
ASPECT = mesh_picture.WIDTH_PX / mesh_picture.HEIGHT_PX


def elevation(height_m: np.ndarray, map_from_world: np.ndarray) -> ElevationMap:
    """Returns a map that is red in the west and green in the east."""
    colours = np.zeros((*height_m.shape, 3), np.uint8)
    colours[:, :40, 0], colours[:, 40:, 1] = 200, 200
    return ElevationMap(GRID, height_m.astype(np.float32), np.full_like(height_m, 0.01), colours, map_from_world)


def write_surface(file: Path, height_m: np.ndarray) -> Path:
    """Writes the mesh of `elevation` in the world."""
    mesh.write_glb(file, elevation(height_m, np.eye(4)))
    return file


@pytest.fixture(scope="module")
def picture(tmp_path_factory):
    return mesh_picture.surface_picture(write_surface(tmp_path_factory.mktemp("map") / "mesh.glb", np.zeros((60, 80))))


def test_the_picture_has_the_colours_of_the_mosaic_with_west_on_the_left(picture):
    assert picture is not None
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    columns = np.arange(picture.shape[1])
    west, east = (red > 100) & (green < 50) & (blue < 50), (green > 100) & (red < 50) & (blue < 50)
    assert west.mean() > 0.2 and east.mean() > 0.2
    assert np.average(columns, weights=west.sum(axis=0)) < np.average(columns, weights=east.sum(axis=0)) - 200


def test_the_mesh_of_a_tilted_rig_is_shown_in_the_frame_of_its_map(monkeypatch, tmp_path):
    height_m = np.random.default_rng(0).normal(size=(60, 80))
    pose = geometry.pose(geometry.so3_exp(np.array([1.2, -0.3, 0.5])), np.array([0.3, -0.2, 1.0]))
    plain, tilted = (mesh.map_mesh(elevation(height_m, turned)).vertices for turned in (np.eye(4), pose))
    assert np.abs(tilted - plain).max() > 1
    np.testing.assert_allclose(mesh_picture.in_map_frame(tilted, pose), plain, atol=1e-6)

    shown = {}
    monkeypatch.setattr("twin.report.survey_page.surface_picture", shown.__setitem__)
    (tmp_path / "keyframes").mkdir()
    (tmp_path / "keyframes" / "index.json").write_text(json.dumps({"map_from_world": pose.tolist()}))
    (tmp_path / "scenario.resolved.toml").write_text("")
    write_report(tmp_path)
    np.testing.assert_array_equal(shown[tmp_path / "mesh.glb"], pose)


def test_slopes_facing_north_west_are_brighter():
    white = np.full((2, 3), 200, np.uint8)
    normals = np.array([[-1.0, 1.0, -1.0], [1.0, 1.0, 1.0]]) / np.sqrt(3)  # east, up, south
    bright, dark = mesh_picture.shaded_colours(white, normals)[:, 0].astype(int)
    assert bright > dark + 60


@pytest.mark.parametrize("shape", [(4.0, 0.3, 1.0), (0.5, 2.0, 6.0), (3.0, 0.0, 3.0)])
def test_the_camera_has_all_points_in_view_at_the_smallest_distance(shape):
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (4000, 3)) * shape + [7.0, -2.0, 30.0]
    low, high = np.percentile(points, mesh_picture.FRAMED_PERCENT, axis=0)
    in_camera = geometry.transform(geometry.inverse(mesh_picture.camera_pose(points)), np.clip(points, low, high))
    tangents = np.tan(np.deg2rad(mesh_picture.VFOV_DEG) / 2) * np.array([ASPECT, 1.0])
    extent = (np.abs(in_camera[:, :2]) / -in_camera[:, 2:] / tangents).max()
    assert in_camera[:, 2].max() < 0 and 0.9 < extent < 1


def test_an_outlier_of_the_height_does_not_change_the_scale():
    x, y = np.meshgrid(np.arange(80) * 0.05, np.arange(60) * 0.05)
    plain = np.column_stack([x.ravel(), np.zeros(x.size), y.ravel()])
    outlier = plain.copy()
    outlier[30 * 80 + 40, 1] = -9.0
    np.testing.assert_allclose(mesh_picture.camera_pose(outlier), mesh_picture.camera_pose(plain), atol=0.01)


def test_the_report_shows_the_surface_unless_its_mesh_is_damaged(picture, tmp_path, monkeypatch):
    mesh_file = write_surface(tmp_path / "mesh.glb", np.zeros((60, 80)))
    (tmp_path / "scenario.resolved.toml").write_text("")
    with monkeypatch.context() as patch:
        patch.setattr("twin.report.survey_page.surface_picture", lambda file, _: {mesh_file: picture}[file])
        assert '<section id="surface">' in write_report(tmp_path).read_text()
    mesh_file.write_bytes(b"not a mesh")
    page = write_report(tmp_path).read_text()
    assert "unfinished" in page and 'id="surface"' not in page


def test_missing_damaged_and_empty_meshes_give_no_picture(tmp_path):
    (tmp_path / "broken.glb").write_bytes(b"not a mesh")
    write_surface(tmp_path / "empty.glb", np.full((60, 80), np.nan))
    for name in ("missing.glb", "broken.glb", "empty.glb"):
        assert mesh_picture.surface_picture(tmp_path / name) is None
