"""Rerun recording: it has every entity on both timelines and stays small."""

import json
import os
import signal
import socket
import subprocess
import threading
import time
import urllib.request
import weakref
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import cv2
import numpy as np
import pytest
import rerun as rr
import rerun.blueprint as rrb
from judge_synthetic import SCENARIO, survey, write_folder
from rerun.chunk import RrdReader
from rerun.experimental import ViewerClient

from twin.core import geometry
from twin.core.records import Estimate, Frame, MapGrid, Readings, StereoRig, Trajectory
from twin.errors import TwinError
from twin.exchange import geotiff
from twin.report import recording, recording_surfaces
from twin.report.frame_recorder import FrameRecorder
from twin.report.images import jpeg_bytes
from twin.report.run_folder import Raster, load_run, read_mosaic
from twin.report.run_writer import link_residuals, position_cov_m2

PATHS = {f"/world/path/{name}" for name in ("truth", "reference", "f2f", "online", "final")}
ERRORS = {f"/error/{what}/{name}" for what in ("position", "height", "heading") for name in ("f2f", "online", "final")}


def contents(file) -> dict[str, tuple[set[str], int]]:
    """Returns timelines and number of rows of every entity of a recording."""
    entities: dict[str, tuple[set[str], int]] = {}
    for chunk in RrdReader(str(file)).stream():
        lines, rows = entities.get(str(chunk.entity_path), (set(), 0))
        entities[str(chunk.entity_path)] = (lines | set(chunk.timeline_names), rows + chunk.num_rows)
    return entities


def rows(file, entity: str) -> list[dict]:
    """Returns the rows of an entity of a recording: frame and components, in the order of time."""
    batches = [c.to_record_batch() for c in RrdReader(str(file)).stream() if str(c.entity_path) == entity]
    found = [row for batch in batches for row in batch.to_pylist() if "frame" in row]
    return sorted(
        ({key.split(":")[-1]: value for key, value in row.items()} for row in found), key=lambda r: r["frame"]
    )


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("recording") / "run")


def test_the_recording_holds_the_whole_survey_on_both_timelines(folder):
    start = time.perf_counter()
    file = recording.record_run(load_run(folder))
    assert time.perf_counter() - start < 10
    assert file == folder / "run.rrd" and file.stat().st_size < 10_000_000
    entities = contents(file)
    expected = PATHS | ERRORS | {"/world", "/world/true_floor", "/world/rig", "/mosaic", "/summary"}
    expected |= {"/world/rig/left", "/world/rig/right", "/timing/f2f", "/timing/stereo", "/timing/ga"}
    expected |= {f"/attitude/{angle}/{name}" for angle in ("roll", "pitch", "heading") for name in ("truth", "final")}
    assert expected <= set(entities)
    for parts in ("map", "network"):
        assert sum(entity.startswith(f"/world/{parts}/") for entity in entities) > 10
    static = {"/world", "/world/true_floor", "/world/path/reference", "/summary"}
    for entity in expected - static:
        assert {"frame", "sim_time"} <= entities[entity][0], entity
    assert entities["/world/rig"][1] == 720
    assert entities["/world/rig/left"][1] == 87 + 1  # images and the camera model


def test_images_are_read_one_by_one(folder, monkeypatch):
    """Hundreds of large images would else be in memory at once."""
    read = []

    def read_rgb(file, before=recording.read_rgb):
        read.append(weakref.ref(image := before(file)))
        assert sum(one() is not None for one in read) <= 2  # this one and the last one
        return image

    monkeypatch.setattr(recording, "read_rgb", read_rgb)
    recording.record_run(load_run(folder))
    assert len(read) > 100


def test_an_unfinished_run_has_a_recording(tmp_path):
    entities = contents(recording.record_run(load_run(write_folder(tmp_path / "run", finished=False))))
    assert {"/world/path/truth", "/world/path/online", "/world/rig/left", "/summary"} <= set(entities)
    assert "/world/path/final" not in entities and "/mosaic" not in entities


def test_a_run_without_results_has_a_recording(tmp_path):
    (tmp_path / "scenario.resolved.toml").write_text("")
    assert "/summary" in contents(recording.record_run(load_run(tmp_path)))


def test_a_folder_that_is_not_a_run_is_rejected(tmp_path):
    with pytest.raises(TwinError, match="is not a run folder"):
        recording.record_run(load_run(tmp_path))
    with pytest.raises(TwinError, match="is not a run folder"):
        recording.open_viewer(tmp_path)


def test_every_triangle_of_the_map_appears_once_and_none_covers_a_hole(folder):
    run = load_run(folder)
    surface = recording_surfaces.map_surface(run.rasters["dem"], run.rasters["mosaic"])
    assert np.isfinite(surface.points[surface.triangles]).all()
    poses = run.trajectories["final"].world_from_camera[run.keyframes.frames]
    group = recording_surfaces.first_observed(surface.points, [poses[:40], poses[40:]], SCENARIO.believed_rig())
    parts = [recording_surfaces.submesh(surface, group, number) for number in (0, 1)]
    shown = np.concatenate([part.points[part.triangles].reshape(-1, 9) for part in parts])
    whole = surface.points[surface.triangles[(group[surface.triangles] < 2).all(axis=1)]].reshape(-1, 9)
    assert len(shown) == len(whole) > 10_000
    np.testing.assert_array_equal(shown[np.lexsort(shown.T)], whole[np.lexsort(whole.T)])


def test_a_map_in_the_plane_of_a_tilted_rig_is_shown_in_the_world(folder, tmp_path):
    """The same survey in a world turned by 120 degrees: as many parts of the map appear, where the cameras see them."""
    run, rig = load_run(folder), SCENARIO.believed_rig()
    map_from_world = geometry.pose(geometry.so3_exp(np.array([2.1, 0.0, 0.0])), np.array([0.5, -2.0, 1.0]))
    paths = {
        name: Trajectory(path.times_s, geometry.inverse(map_from_world) @ path.world_from_camera)
        for name, path in run.trajectories.items()
    }
    turned = replace(run, trajectories=paths, keyframes=run.keyframes._replace(map_from_world=map_from_world))
    parts = []
    for number, shown in enumerate((run, turned)):
        stream = rr.RecordingStream("map_test")
        stream.save(tmp_path / f"{number}.rrd")
        recording.log_map(stream, shown, rig)
        stream.flush()
        stream.disconnect()
        parts.append({name for name in contents(tmp_path / f"{number}.rrd") if name.startswith("/world/map/")})
    assert parts[0] == parts[1] and len(parts[0]) > 10


def test_a_surface_in_the_world_keeps_its_angles_between_normals_and_edges():
    height = np.random.default_rng(0).normal(0, 0.1, (8, 9))
    surface = recording_surfaces.floor_surface(Raster(MapGrid(0, 0, 0.5, 8, 9), height))
    map_from_world = geometry.pose(geometry.so3_exp(np.array([0.3, -1.2, 0.7])), np.array([0.5, -2.0, 1.0]))
    turned = recording_surfaces.in_world(surface, map_from_world)
    np.testing.assert_allclose(geometry.transform(map_from_world, turned.points), surface.points, atol=1e-12)
    edges, turned_edges = (s.points[s.triangles[:, 1]] - s.points[s.triangles[:, 0]] for s in (surface, turned))
    first = surface.triangles[:, 0]
    np.testing.assert_allclose(
        (turned_edges * turned.normals[first]).sum(1), (edges * surface.normals[first]).sum(1), atol=1e-12
    )


def test_the_camera_model_of_an_upright_image_has_the_size_of_the_logged_image():
    """480 x 640 px become 240 x 320 px, as the longest side of a logged image is 320 px."""
    logged = {}

    class Stream:
        def log(self, entity, *components, static):
            logged[entity] = components[-1]

    recording.log_rig(Stream(), StereoRig(480, 640, 500.0, 0.1))  # pyright: ignore[reportArgumentType]
    assert logged["world/rig/left"].resolution.as_arrow_array().to_pylist() == [[240, 320]]


@pytest.mark.parametrize("most_px", [10**6, 5000, 900])
def test_a_reduced_orthomosaic_colours_the_map_where_the_whole_one_does(tmp_path, monkeypatch, most_px):
    """A ramp of colours over 20 x 30 cells of 7 x 7 pixels, read at full size, reduced to a third and to a ninth."""
    cells, pixels = MapGrid(-0.6, 0.5, 0.07, 20, 30), MapGrid(-0.6, 0.5, 0.01, 140, 210)
    x, y = np.meshgrid(*pixels.centres())
    ramp = np.stack([200 * (x + 0.6) / 2.1, 200 * (0.5 - y) / 1.4, 0 * x + 50], axis=-1)
    geotiff.write_mosaic(tmp_path / "mosaic.tif", np.round(ramp).astype(np.uint8), pixels)
    monkeypatch.setattr("twin.exchange.geotiff.MAX_MOSAIC_PX", most_px)
    mosaic = read_mosaic(tmp_path / "mosaic.tif")
    surface = recording_surfaces.map_surface(Raster(cells, np.zeros((20, 30))), mosaic)
    at = np.stack([200 * (surface.points[:, 0] + 0.6) / 2.1, 200 * (0.5 - surface.points[:, 1]) / 1.4], axis=-1)
    # a pixel of the reduced orthomosaic is at most 0.1 m wide: 10 and 14 levels; up to one is missing at the edge
    error = np.abs(surface.colours[:, :2].astype(float) - at)
    assert (error.max(axis=0) < 1 + 1.5 * 200 * mosaic.grid.cell_m / np.array([2.1, 1.4])).all()
    assert (surface.colours[:, 2] == 50).all()


def test_an_orthomosaic_of_another_area_does_not_colour_the_map():
    dem = Raster(MapGrid(0, 0, 0.1, 20, 30), np.zeros((20, 30)))
    for grid in (MapGrid(0.05, 0, 0.01, 200, 300), MapGrid(0, 0, 0.01, 200, 400)):
        other = Raster(grid, np.full((grid.rows, grid.cols, 3), 7, np.uint8))
        assert not (recording_surfaces.map_surface(dem, other).colours == 7).all()


def test_triangles_face_upwards():
    height = np.random.default_rng(0).normal(0, 0.1, (8, 9))
    surface = recording_surfaces.floor_surface(Raster(MapGrid(0, 0, 0.5, 8, 9), height))
    a, b, c = np.moveaxis(surface.points[surface.triangles], 1, 0)
    assert (np.cross(b - a, c - a)[:, 2] > 0).all()
    assert len(surface.triangles) == 2 * 7 * 8
    assert (surface.normals[:, 2] > 0).all()


def test_a_point_belongs_to_the_first_group_that_has_it_in_an_image():
    rig = SCENARIO.believed_rig()
    down = [geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([x, 0.0, 2.0])) for x in (0.0, 5.0)]
    half_along = 2.0 * rig.height_px / 2 / rig.focal_px
    x = np.array([0.0, half_along - 0.01, half_along + 0.01, 5.0, np.nan])
    points = np.column_stack([x, np.zeros((5, 2))])
    groups = recording_surfaces.first_observed(points, [np.array(down[:1]), np.array(down[1:])], rig)
    np.testing.assert_array_equal(groups, [0, 0, recording_surfaces.NOT_OBSERVED, 1, recording_surfaces.NOT_OBSERVED])


def test_images_keep_their_colours_in_the_recording():
    image = np.zeros((48, 64, 3), np.uint8) + np.array([200, 100, 30], np.uint8)
    data = np.frombuffer(jpeg_bytes(image, 32), np.uint8)
    shown = cv2.imdecode(data, cv2.IMREAD_COLOR_RGB)
    assert shown.shape == (24, 32, 3)
    np.testing.assert_allclose(shown.mean(axis=(0, 1)), [200, 100, 30], atol=4)


def test_the_live_viewer_logs_every_frame_and_the_path_at_keyframes(tmp_path):
    _, _, truth, rig = survey()
    stream = rr.RecordingStream("live_test")
    stream.save(tmp_path / "live.rrd")
    viewer = recording.LiveViewer(rig, stream)
    image = np.zeros((rig.height_px, rig.width_px, 3), np.uint8)
    for k in range(6):
        pose = truth.trajectory.world_from_camera[k]
        right = image if k % 3 == 0 else None
        estimate = Estimate(k / 30, pose, pose, np.zeros(6), 0.01, "ok")
        viewer.log_frame(Frame(k, k / 30, image, right, Readings()), estimate)
    stream.flush()
    stream.disconnect()
    entities = contents(tmp_path / "live.rrd")
    assert entities["/world/rig"][1] == 6 and entities["/world/path/online"][1] == 2
    assert {"frame", "sim_time"} <= entities["/world/rig"][0]


@pytest.mark.parametrize("shape", [(1, 5), (5, 1), (2, 300_000)])
def test_a_map_of_one_row_or_column_has_a_surface_without_triangles(shape):
    """The last shape has one row after subsampling."""
    surface = recording_surfaces.floor_surface(Raster(MapGrid(0, 0, 0.1, *shape), np.zeros(shape)))
    assert len(surface.triangles) == 0 and (surface.normals == [0, 0, 1]).all()


def test_the_map_grows_and_the_orthomosaic_appears_at_the_end(folder):
    run = load_run(folder)
    file = recording.record_run(run)
    assert [row["frame"] for row in rows(file, "/mosaic")] == [len(run.times_s) - 1]
    first = [rows(file, entity)[0]["frame"] for entity in contents(file) if entity.startswith("/world/map/")]
    assert min(first) == 0 and len(set(first)) == len(first) > 10


def random_rotations(n: int, seed: int) -> np.ndarray:
    return np.array([geometry.so3_exp(w) for w in np.random.default_rng(seed).normal(0, 2, (n, 3))])


def test_ellipsoids_are_two_sigma_along_the_principal_axes():
    """Covariances with known standard deviations 1, 2 and 5 mm along known axes."""
    rotations = random_rotations(20, 0)
    cov = rotations @ np.diag([4e-6, 25e-6, 1e-6]) @ rotations.transpose(0, 2, 1)
    half_axes_m, quaternions = recording.ellipsoids(cov)
    np.testing.assert_allclose(half_axes_m, [[0.002, 0.004, 0.010]] * 20, rtol=1e-9)
    axes = geometry.rotation_from_wxyz(quaternions[:, [3, 0, 1, 2]])
    alignment = np.abs(np.einsum("nij,nik->njk", rotations, axes))  # of the known axes with those of the ellipsoid
    np.testing.assert_allclose(alignment, [[[0, 1, 0], [0, 0, 1], [1, 0, 0]]] * 20, atol=1e-6)


@pytest.mark.parametrize("sigma_m", [1e-7, 3e-5, 1e-3, 0.2, 30.0])
def test_the_enlargement_is_the_largest_with_which_ellipsoids_stay_small(sigma_m):
    half_axes_m = sigma_m * np.array([[0.1, 0.5, 2.0], [0.1, 0.2, 0.3]])
    factor = recording.enlargement(half_axes_m, 4.0)
    assert factor == 1 or factor * 2 * sigma_m <= 0.02 * 4.0
    assert factor == 10_000 or 10 * factor * 2 * sigma_m > 0.02 * 4.0


def test_the_recording_has_the_ellipsoids_of_the_final_covariances(folder):
    """All standard deviations are 1 mm; ten times two of them are 20 mm, 0.5 % of the path; 2 % are allowed."""
    run = load_run(folder)
    run = replace(run, keyframes=run.keyframes._replace(position_cov_m2=run.keyframes.position_cov_m2 / 100))
    file = recording.record_run(run)
    shown = rows(file, "/world/position_2_sigma_times_10")
    assert len(shown) == recording.N_SNAPSHOTS
    np.testing.assert_allclose(shown[-1]["half_sizes"], np.full((87, 3), 0.02), rtol=1e-6)
    np.testing.assert_allclose(shown[-1]["centers"], run.network.positions, atol=1e-6)
    assert [len(row["centers"]) for row in shown][:3] == [1, 4, 8]  # those up to the keyframe of the snapshot


def test_covariances_of_positions_are_turned_into_the_world():
    """The same motion of the same noise, seen from the world: samples of positions have this covariance."""
    rng, poses = np.random.default_rng(1), np.tile(np.eye(4), (3, 1, 1))
    poses[:, :3, :3] = random_rotations(3, 2)
    root = rng.normal(0, 0.01, (3, 6, 6))
    cov = root @ root.transpose(0, 2, 1)
    cov[2, 4, 4] = np.nan
    result = SimpleNamespace(final=Trajectory(np.arange(3.0), poses), keyframe_rows=np.arange(3), node_cov=cov)
    turned = position_cov_m2(result)  # pyright: ignore[reportArgumentType]
    for k in range(2):
        moved = [poses[k] @ geometry.exp(root[k] @ sample) for sample in rng.normal(0, 1, (20_000, 6))]
        # the standard deviation of a variance of n samples is sqrt(2 / n) of it; five of them
        np.testing.assert_allclose(turned[k], np.cov(np.array(moved)[:, :3, 3].T), atol=0.05 * turned[k].max())
    assert np.isfinite(turned[2]).all()


def test_normalised_residuals_of_links_are_one_for_consistent_covariances():
    """The errors of the synthetic links are drawn from their covariances; here, the final poses are the true ones."""
    result, _, truth, _ = survey()
    residuals = link_residuals(replace(result, final=truth.trajectory))
    assert len(residuals) == len(result.links) > 200
    # r' C^-1 r / 6 has the variance 2 / 6, and the mean over n links sqrt(2 / 6 / n); four of them
    assert np.mean(residuals**2) == pytest.approx(1, abs=4 * np.sqrt(2 / 6 / len(residuals)))


def test_links_are_coloured_by_their_residuals(folder):
    run = load_run(folder)
    large = run.keyframes.link_residuals.copy()
    large[:], large[-1] = 0.9, 3.1
    marked = replace(run, keyframes=run.keyframes._replace(link_residuals=large))
    file = recording.record_run(marked)
    parts = [entity for entity in contents(file) if entity.startswith("/world/network/")]
    logged = [row for part in parts for row in rows(file, part)]
    colours = [f"{colour:08x}"[:6] for row in logged for colour in row["colors"]]
    assert sorted(colours) == ["7f96a3"] * (len(large) - 1) + ["cc3311"]  # each link once
    shown = np.concatenate([np.reshape(row["strips"], (-1, 2, 3)) for row in logged])
    positions, edges = run.network
    for side in range(2):
        expected, found = (np.sort(points[:, 0]) for points in (positions[edges[:, side]], shown[:, side]))
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=1e-5)
    keys = run.keyframes
    for part in parts:  # a link appears at the first snapshot that has both its keyframes
        (row,) = rows(file, part)
        assert row["frame"] == keys.frames[recording.snapshots(len(keys.frames))[int(part[-2:])]]


def test_events_of_the_log_are_logged_at_their_times(folder):
    lines = [
        '{"event": "started", "time_s": 0.0, "name": "synthetic"}',
        '{"event": "vision", "time_s": 12.5, "status": "too few matches"}',
        '{"event": "vision", "time_s": 13.0, "status": "ok"}',
        '{"event": "aligned", "track": 1, "ms": 388.93616}',
        '{"event": "finding", "text": "a doubt"}',
        "null", "{}", '{"event": "aligned", "tra',
    ]  # fmt: skip
    (folder / "log.jsonl").write_text("\n".join(lines))
    run = load_run(folder)
    try:
        events = rows(recording.record_run(run), "/events")
    finally:
        (folder / "log.jsonl").unlink()
    end_of_track = int(run.keyframes.frames[run.keyframes.tracks == 1][-1])
    expected = [
        (0, "INFO", "event started, time_s 0, name synthetic"),
        (125, "WARN", "event vision, time_s 12.5, status too few matches"),
        (130, "INFO", "event vision, time_s 13, status ok"),
        (end_of_track, "INFO", "event aligned, track 1, ms 388.9"),
        (719, "WARN", "event finding, text a doubt"),
        (719, "WARN", "event "),
    ]
    assert [(row["frame"], row["level"][0], row["text"][0]) for row in events] == expected


def test_curves_of_the_attitude_are_those_of_the_body(folder):
    """A camera that looks forward and down, on a body at known angles; the heading passes 180 deg."""
    heading_deg = np.linspace(170, 190, 720)
    bodies = [geometry.rotation_from_rpy(0.02, -0.05, np.deg2rad(angle)) for angle in heading_deg]
    body_from_camera = geometry.pose(
        geometry.rotation_from_rpy(0, -0.4, 0) @ geometry.BODY_FROM_DOWN_CAMERA, np.array([0.3, 0.0, 0.1])
    )
    run = load_run(folder)
    path = Trajectory(run.times_s, np.array([geometry.pose(body, np.zeros(3)) @ body_from_camera for body in bodies]))
    logged = {}

    def log_curve(stream, run, entity, frames, values, role=""):
        logged[entity] = values

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recording, "log_curve", log_curve)
        rig = replace(SCENARIO.believed_rig(), body_from_camera=body_from_camera)
        recording.log_curves(None, replace(run, trajectories={"online": path}), rig)  # pyright: ignore[reportArgumentType]
    np.testing.assert_allclose(logged["attitude/roll/online"], np.rad2deg(0.02), atol=1e-9)
    np.testing.assert_allclose(logged["attitude/pitch/online"], np.rad2deg(-0.05), atol=1e-9)
    np.testing.assert_allclose(logged["attitude/heading/online"], heading_deg, atol=1e-9)


def test_the_thrusts_of_a_recorded_flight_become_curves(folder, tmp_path, monkeypatch):
    thrusts, poses = np.random.default_rng(4).normal(0, 5, (7, 3)), np.tile(np.eye(4), (7, 1, 1))
    logged = {}

    def log_curve(stream, run, entity, frames, values, role=""):
        logged[entity] = values

    monkeypatch.setattr(recording, "log_curve", log_curve)
    flown = replace(load_run(folder), folder=tmp_path, trajectories={})
    recording.log_curves(None, flown, SCENARIO.believed_rig())  # pyright: ignore[reportArgumentType]
    assert not [entity for entity in logged if "thrust" in entity]  # nothing is recorded
    with FrameRecorder(tmp_path, "keyframes") as recorder:
        for k, (pose, thrust_n) in enumerate(zip(poses, thrusts, strict=True)):
            recorder.add(Frame(k, k / 30, np.zeros((4, 4, 3), np.uint8), None, Readings()), pose, np.zeros(6), thrust_n)
    recording.log_curves(None, flown, SCENARIO.believed_rig())  # pyright: ignore[reportArgumentType]
    np.testing.assert_array_equal([logged[f"thrust/{k}"] for k in (1, 2, 3)], thrusts.T)


def views(part) -> list:
    return (
        [view for inner in part.contents for view in views(inner)]
        if hasattr(part, "contents") and not isinstance(part, rrb.View)
        else [part]
    )


def test_the_alignments_have_an_axis_of_their_own():
    of_timing = {
        view.origin: view.contents for view in views(recording.blueprint().root_container) if "timing" in view.origin
    }
    assert of_timing == {"/timing": ["$origin/**", "- $origin/ga"], "/timing/ga": "$origin/**"}


def test_the_view_opens_with_all_of_the_survey_in_sight(folder):
    """All of the map and all positions are within 24 deg of the optical axis; the view is 55 deg high."""
    run = load_run(folder)
    eye = recording._overview(run)
    assert eye is not None
    position, target = (np.array(part.as_arrow_array().to_pylist()[0]) for part in (eye.position, eye.look_target))
    cells = np.stack([*np.meshgrid(*run.rasters["dem"].grid.centres()), run.rasters["dem"].values], axis=-1)
    points = np.concatenate([run.trajectories["truth"].positions, cells[np.isfinite(run.rasters["dem"].values)]])
    rays, axis = points - position, (target - position) / np.linalg.norm(target - position)
    angles_deg = np.rad2deg(np.arccos(rays @ axis / np.linalg.norm(rays, axis=1)))
    assert 10 < angles_deg.max() < 24


def test_covariances_of_another_shape_are_rejected(folder, tmp_path):
    index = json.loads((folder / "keyframes" / "index.json").read_text()) | {"position_cov_m2": [[[1.0, 2.0, 3.0]]]}
    (tmp_path / "keyframes").mkdir()
    (tmp_path / "scenario.resolved.toml").write_text("")
    (tmp_path / "keyframes" / "index.json").write_text(json.dumps(index))
    with pytest.raises(TwinError, match="position_cov_m2: must have 3 rows of 3 numbers for each keyframe"):
        load_run(tmp_path)


def free_port() -> int:
    with socket.socket() as found:
        found.bind(("127.0.0.1", 0))
        return found.getsockname()[1]


def listening_at(port: int) -> list[str]:
    """Returns the addresses at which processes of this machine accept connections to a port."""
    rows = [line.split() for file in ("tcp", "tcp6") for line in Path("/proc/net", file).read_text().splitlines()[1:]]
    ends = [row[1].split(":") for row in rows if row[3] == "0A"]  # in the state LISTEN
    return [address for address, number in ends if int(number, 16) == port]


@pytest.mark.long
def test_a_browser_of_this_machine_alone_is_served_until_ctrl_c(folder, monkeypatch, capfd):
    web, data = free_port(), free_port()
    ports = ("--web-viewer-port", str(web), "--port", str(data))
    monkeypatch.setattr(recording, "VIEWER", (*recording.VIEWER, *ports))
    monkeypatch.setenv("BROWSER", "true")  # the program, which opens nothing
    seen = {}

    def visit():
        for _ in range(300):
            try:
                seen["page"] = urllib.request.urlopen(f"http://127.0.0.1:{web}/", timeout=5).read()
                break
            except OSError:
                time.sleep(0.1)
        seen.update({port: listening_at(port) for port in (web, data)})
        os.kill(os.getpid(), signal.SIGINT)

    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell may start tests with SIGINT ignored
    threading.Thread(target=visit).start()
    assert recording.open_viewer(folder, web=True) == 0
    signal.signal(signal.SIGINT, before)
    assert b"<html" in seen["page"] and seen[web] == seen[data] == ["0100007F"]  # 127.0.0.1
    assert capfd.readouterr().out.endswith(f"Closed {folder / 'run.rrd'}\n")
    deadline = time.monotonic() + 10
    while listening_at(web) + listening_at(data) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert listening_at(web) + listening_at(data) == []


#: Driver of Vulkan that draws without a GPU (lavapipe, Debian's package mesa-vulkan-drivers).
LAVAPIPE = next(Path("/usr/share/vulkan/icd.d").glob("lvp_icd*.json"), None)


def map_pixels(picture: np.ndarray) -> np.ndarray:
    """Returns the mask of the pixels of a 3-D view that show the map, which is yellow in the synthetic survey."""
    return picture[..., 2].astype(int) - picture[..., 0] > 15


@pytest.mark.long
@pytest.mark.skipif(LAVAPIPE is None, reason="Vulkan without a GPU (mesa-vulkan-drivers) is not installed")
def test_the_viewer_opens_on_the_whole_map(folder, tmp_path):
    """A picture of the 3-D view, drawn by the viewer without a screen; the map lies within it, on black."""
    file, port, shot = recording.record_run(load_run(folder)), free_port(), tmp_path / "view.png"
    command = [
        *recording.VIEWER,
        "--headless",
        "--port",
        str(port),
        "--renderer",
        "vulkan",
        "--window-size",
        "1000x700",
    ]
    environment = os.environ | {"VK_ICD_FILENAMES": str(LAVAPIPE), "XDG_RUNTIME_DIR": str(tmp_path)}
    log, picture, frame = (tmp_path / "log").open("w"), np.zeros((1, 1, 3), np.uint8), None
    viewer = subprocess.Popen(
        [*command, str(file)], env=environment, stdout=log, stderr=log, start_new_session=True
    )  # fmt: skip
    try:
        deadline = time.monotonic() + 60
        while map_pixels(picture).mean() < 0.1 and time.monotonic() < deadline and viewer.poll() is None:
            time.sleep(0.5)
            with suppress(RuntimeError, ConnectionError, StopIteration):  # it has not loaded everything yet
                client = ViewerClient.connect(f"rerun+http://127.0.0.1:{port}/proxy")
                state = client.get_state()
                client.save_screenshot(str(shot), next(view.view_id for view in state.views if view.name == "Survey"))
                frame = state.recordings[0].current_time
                picture = np.asarray(cv2.imread(str(shot)))
    finally:
        os.killpg(viewer.pid, signal.SIGTERM)
        viewer.wait()
        log.close()
    assert frame == 719  # the last one
    shown, background = map_pixels(picture), picture.max(axis=2) < 20
    assert 0.1 < shown.mean() < 0.7 and 0.1 < background.mean() < 0.8, (tmp_path / "log").read_text()[-2000:]
    assert not np.concatenate([shown[[0, -1]].ravel(), shown[:, [0, -1]].ravel()]).any()
    assert len(np.unique(picture[shown], axis=0)) > 500  # the colours of the orthomosaic, not of one surface
