"""The picture of the map's surface: its colours, its frame, and none where it cannot be drawn."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from judge_synthetic import write_folder

from twin.core import geometry
from twin.core.records import ElevationMap, MapGrid
from twin.exchange import mesh
from twin.report import mesh_picture
from twin.report.survey_page import write_report

GRID = MapGrid(-2.0, 1.5, 0.05, 60, 80)
ASPECT = mesh_picture.WIDTH_PX / mesh_picture.HEIGHT_PX


def write_surface(file: Path, height_m: np.ndarray) -> Path:
    """A map that is red in the west and green in the east."""
    colours = np.zeros((*height_m.shape, 3), np.uint8)
    colours[:, :40, 0], colours[:, 40:, 1] = 200, 200
    mesh.write_glb(file, ElevationMap(GRID, height_m.astype(np.float32), np.full_like(height_m, 0.01), colours))
    return file


def test_the_surface_shows_the_mosaics_colours_with_west_on_the_left(tmp_path):
    picture = mesh_picture.surface_picture(write_surface(tmp_path / "mesh.glb", np.zeros((60, 80))))
    assert picture is not None
    red, green, blue = np.moveaxis(picture.astype(int), 2, 0)
    columns = np.arange(picture.shape[1])
    west, east = (red > 100) & (green < 50) & (blue < 50), (green > 100) & (red < 50) & (blue < 50)
    assert west.mean() > 0.2 and east.mean() > 0.2
    assert np.average(columns, weights=west.sum(axis=0)) < np.average(columns, weights=east.sum(axis=0)) - 200


def test_the_north_west_side_of_a_rise_is_the_brighter_one():
    white = np.full((2, 3), 200, np.uint8)
    towards = np.array([[-1.0, 1.0, -1.0], [1.0, 1.0, 1.0]]) / np.sqrt(3)  # east, up, south
    bright, dark = mesh_picture.lit(white, towards)[:, 0].astype(int)
    assert bright > dark + 60


@pytest.mark.parametrize("shape", [(4.0, 0.3, 1.0), (0.5, 2.0, 6.0), (3.0, 0.0, 3.0)])
def test_the_eye_sees_all_and_stands_no_farther_than_it_must(shape):
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (4000, 3)) * shape + [7.0, -2.0, 30.0]
    low, high = np.percentile(points, mesh_picture.FRAMED_PERCENT, axis=0)
    seen = geometry.transform(geometry.inverse(mesh_picture.eye(points)), np.clip(points, low, high))
    tangents = np.tan(np.deg2rad(mesh_picture.VFOV_DEG) / 2) * np.array([ASPECT, 1.0])
    reach = (np.abs(seen[:, :2]) / -seen[:, 2:] / tangents).max()
    assert seen[:, 2].max() < 0 and 0.9 < reach < 1


def test_a_wild_height_does_not_shrink_the_rest(tmp_path):
    height = np.zeros((60, 80))
    height[30, 40] = -9.0
    tame = mesh_picture.surface_picture(write_surface(tmp_path / "tame.glb", np.zeros((60, 80))))
    wild = mesh_picture.surface_picture(write_surface(tmp_path / "wild.glb", height))
    assert tame is not None and wild is not None and wild.shape[1] == pytest.approx(tame.shape[1], abs=3)


def test_the_report_shows_the_surface(tmp_path):
    folder = write_folder(tmp_path / "run")
    write_surface(folder / "mesh.glb", np.zeros((60, 80)))
    assert '<section id="surface">' in write_report(folder).read_text()


def test_the_report_does_without_where_nothing_draws(tmp_path, monkeypatch):
    write_surface(tmp_path / "mesh.glb", np.zeros((60, 80)))
    (tmp_path / "scenario.resolved.toml").write_text("")
    monkeypatch.setenv("PYOPENGL_PLATFORM", "none such")
    page = write_report(tmp_path).read_text()
    assert "unfinished" in page and 'id="surface"' not in page


def test_what_cannot_be_drawn_is_no_picture(tmp_path, monkeypatch):
    (tmp_path / "broken.glb").write_bytes(b"no mesh")
    write_surface(tmp_path / "empty.glb", np.full((60, 80), np.nan))
    for name in ("missing.glb", "broken.glb", "empty.glb"):
        assert mesh_picture.surface_picture(tmp_path / name) is None
    monkeypatch.setattr(mesh_picture, "LIMIT_S", 0.05)
    assert mesh_picture.surface_picture(write_surface(tmp_path / "slow.glb", np.zeros((60, 80)))) is None
