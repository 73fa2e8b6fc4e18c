"""Synthetic survey for the tests of judge and report: smooth true path, drifting estimates, analytic floor."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import rasterio

from twin.core import geometry
from twin.core.links import Link, Links
from twin.core.records import Alignment, ElevationMap, MapGrid, StereoRig, SurveyResult, Trajectory, Truth
from twin.core.timing import Stopwatch
from twin.judge.map_error import height_error
from twin.judge.metrics import EvaluationInput, evaluate
from twin.report.run_writer import link_residuals, position_cov_m2
from twin.scenario.file import dump_toml
from twin.scenario.model import Scenario

SCENARIO = Scenario.model_validate(
    {"name": "synthetic", "seed": 7, "plan": {"area_m": [4.0, 1.5]}, "require": {"map.le90_m": 0.05}}
)
SPEED_MPS, ALTITUDE_M, LEG_M, SPACING_M = 0.25, 2.2, 4.0, 0.5


def reference_path(rate_hz: float, legs: int = 4, hold_s: float = 1.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Returns a lawnmower path at constant speed: two legs per track, followed by station keeping.

    Returns:
        (n, 3) positions [m]; (n,) bool, station keeping; (n,) track number.
    """
    step = SPEED_MPS / rate_hz
    points, holding, track = [], [], []
    for leg in range(legs):
        y, sign = leg * SPACING_M - SPACING_M * (legs - 1) / 2, 1 if leg % 2 == 0 else -1
        xs = sign * np.arange(-LEG_M / 2, LEG_M / 2, step)
        ys = np.arange(y, y + SPACING_M, step) if leg < legs - 1 else np.zeros(0)
        piece = np.vstack(
            [np.column_stack([xs, np.full(len(xs), y)]), np.column_stack([np.full(len(ys), sign * LEG_M / 2), ys])]
        )
        n_hold = int(hold_s * rate_hz) if leg % 2 else 0
        points += [piece, np.tile(piece[-1:], (n_hold, 1))]
        holding += [False] * len(piece) + [True] * n_hold
        track += [leg // 2 + 1] * (len(piece) + n_hold)
    xy = np.vstack(points)
    return np.column_stack([xy, np.full(len(xy), ALTITUDE_M)]), np.array(holding), np.array(track)


def true_poses(reference: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Returns down-looking camera poses (n, 4, 4) that oscillate about the reference by 1 cm and 1 deg."""
    t = np.arange(len(reference)) / 30
    oscillation = np.stack([np.sin(t * rng.uniform(0.2, 0.6) + rng.uniform(0, 6)) for _ in range(6)], axis=1)
    poses = np.tile(np.eye(4), (len(t), 1, 1))
    poses[:, :3, 3] = reference + 0.01 * oscillation[:, :3]
    for k, angles in enumerate(np.deg2rad(oscillation[:, 3:])):
        poses[k, :3, :3] = geometry.rotation_from_rpy(*angles) @ geometry.BODY_FROM_DOWN_CAMERA
    return poses


def drifted(poses: np.ndarray, rng: np.random.Generator, sigma: float) -> np.ndarray:
    """Returns the poses with the drift of dead reckoning: a random motion [rad, m] added at every frame."""
    result = poses.copy()
    for k in range(1, len(poses)):
        noise = geometry.exp(rng.normal(0, sigma, 6) * [0.2, 0.2, 0.2, 1, 1, 1])
        result[k] = result[k - 1] @ geometry.inverse(poses[k - 1]) @ poses[k] @ noise
    return result


def floor(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    """Returns the height of the floor [m]."""
    bumps = 0.12 * np.sin(2.1 * x) * np.cos(1.7 * y) + 0.05 * np.sin(7 * x + 3 * y)
    return 0.25 + bumps + 0.25 * np.exp(-((x - 0.5) ** 2 + y**2) / 0.15)


def survey(seed: int = 0, rate_hz: float = 10.0) -> tuple[SurveyResult, ElevationMap, Truth, StereoRig]:
    """Returns result, elevation map, truth and rig of a synthetic survey."""
    rng = np.random.default_rng(seed)
    reference, holding, track = reference_path(rate_hz)
    poses = true_poses(reference, rng)
    times = np.arange(len(poses)) / rate_hz
    f2f, online, final = (Trajectory(times, drifted(poses, rng, s)) for s in (2e-3, 7e-4, 1e-4))
    keys = np.arange(0, len(poses), 8)
    keys = keys[~holding[keys]]
    rig = SCENARIO.believed_rig()
    grid = MapGrid(-2.5, 1.5, 0.02, 150, 250)
    grid_points = np.meshgrid(*grid.centres())
    height = floor(*grid_points).astype(np.float32)
    y, x = np.mgrid[: grid.rows, : grid.cols]
    seen = np.hypot((x - 125) / 120, (y - 75) / 70) < 1
    sigma = np.full(height.shape, 0.008, np.float32)
    estimate = np.where(seen, height + rng.normal(0, sigma), np.nan).astype(np.float32)
    estimate[40:48, 60:70] = np.nan
    shade = np.clip(90 + 200 * height + rng.normal(0, 8, height.shape), 0, 255)[..., None] * [1.0, 0.95, 0.8]
    mosaic = np.where(np.isfinite(estimate)[..., None], shade, 0).astype(np.uint8)
    links = Links(link_between(poses[keys], i, i + d, rng) for d in (1, 2, 4) for i in range(len(keys) - d))
    ends = [int((track[keys] <= t).sum()) for t in (1, 2)]
    node_cov = np.tile(np.diag([1e-6] * 3 + [1e-4] * 3), (len(keys), 1, 1))
    result = SurveyResult(f2f, online, final, keys, track[keys], node_cov, links=links)
    result.alignments = [Alignment(t, 100.0 * t, n, 3 * n, 2) for t, n in enumerate(ends, 1)]
    result.before_ga = [online.positions[keys[:n]] for n in ends]
    result.after_ga = [final.positions[keys[:n]] for n in ends]
    asked = np.logical_and(*(np.abs(c) <= side / 2 for c, side in zip(grid_points, SCENARIO.plan.area_m, strict=True)))
    truth = Truth(Trajectory(times, poses), reference, holding, track, height, seen, asked)
    return result, ElevationMap(grid, estimate, np.where(np.isfinite(estimate), sigma, np.nan), mosaic), truth, rig


def link_between(world_from_keyframe: np.ndarray, i: int, j: int, rng: np.random.Generator) -> Link:
    """Returns a link with an error drawn from its covariance, and a closed form with three times that error."""
    true = geometry.inverse(world_from_keyframe[i]) @ world_from_keyframe[j]
    error = rng.normal(0, 1, 6) * [2e-4, 2e-4, 2e-4, 5e-4, 5e-4, 5e-4]
    cov = 3 * np.diag([4e-8] * 3 + [25e-8] * 3)
    exact = true @ geometry.exp(3 * error)
    return Link(i, j, true @ geometry.exp(error), cov, 0.8, 200, shared_by=3, closed_form=exact)


def evaluated(result: SurveyResult, elevation: ElevationMap | None, truth: Truth, rig: StereoRig) -> dict:
    """Returns the metrics of a survey, with plausible timing."""
    stages = Stopwatch().summary()
    stages["f2f"] = {"count": 900, "mean_ms": 14.0, "p95_ms": 21.0, "total_s": 12.6}
    stages["stereo"] = {"count": 100, "mean_ms": 35.0, "p95_ms": 50.0, "total_s": 3.5}
    stages["ga"] = {"count": 2, "mean_ms": 150.0, "p95_ms": 195.0, "total_s": 0.3}
    timing = {"wall_s": 60.0, "simulated_s": 72.0, "peak_rss_mb": 800.0, "stages": stages}
    identity = dict(name="synthetic", seed=7, version="0.1", scenario_hash="ab12", status="complete", reason=None)
    plan = {"overlap_along": 0.9, "overlap_across": 0.8}
    return evaluate(EvaluationInput(result, elevation, truth, rig, plan, timing, identity, SCENARIO.require))


def write_folder(folder: Path, finished: bool = True) -> Path:
    """Writes a run folder of the synthetic survey; an unfinished one has no maps, metrics and final trajectory."""
    result, elevation, truth, rig = survey()
    (folder / "keyframes").mkdir(parents=True)
    (folder / "scenario.resolved.toml").write_text(dump_toml(SCENARIO))
    (folder / "env.json").write_text(json.dumps({"python": "3.11", "cpu": "x86-64", "packages": {"numpy": "2"}}))
    truth.trajectory.save(folder / "trajectory_truth.tum")
    reference = np.tile(np.eye(4), (len(truth.reference), 1, 1))
    reference[:, :3, 3] = truth.reference
    Trajectory(truth.trajectory.times_s, reference).save(folder / "trajectory_reference.tum")
    result.f2f.save(folder / "trajectory_f2f.tum")
    result.online.save(folder / "trajectory_online.tum")
    _write_keyframes(folder / "keyframes", result, rig)
    if finished:
        result.final.save(folder / "trajectory_final.tum")
        _write_network(folder / "posegraph.g2o", result)
        error = height_error(elevation, truth)
        maps = dict(dem=elevation.height_m, dem_sigma=elevation.sigma_m, dem_truth=truth.height_m, dem_error=error)
        for name, values in maps.items():
            write_tif(folder / f"{name}.tif", elevation.grid, values[None].astype(np.float32))
        write_tif(folder / "mosaic.tif", elevation.grid, np.moveaxis(elevation.mosaic, 2, 0))
        (folder / "metrics.json").write_text(json.dumps(evaluated(result, elevation, truth, rig), allow_nan=False))
    return folder


def write_tif(file: Path, grid: MapGrid, bands: np.ndarray) -> None:
    """Writes bands (n, rows, cols) as GeoTIFF; row 0 is the northernmost, and the nodata value of floats is NaN."""
    transform = rasterio.Affine(grid.cell_m, 0, grid.west_m, 0, -grid.cell_m, grid.north_m)
    profile = dict(driver="GTiff", height=grid.rows, width=grid.cols, count=len(bands), dtype=bands.dtype)
    nodata = np.nan if bands.dtype.kind == "f" else None
    with rasterio.open(file, "w", transform=transform, nodata=nodata, **profile) as sink:
        sink.write(bands)


def _write_network(file: Path, result: SurveyResult) -> None:
    poses = result.final.world_from_camera[result.keyframe_rows]
    lines = [
        f"VERTEX_SE3:QUAT {k} " + " ".join(map(str, [*p[:3, 3], *geometry.quaternion_xyzw(p[:3, :3])]))
        for k, p in enumerate(poses)
    ]
    lines += [f"EDGE_SE3:QUAT {link.i} {link.j} 0 0 0 0 0 0 1 " + " ".join(["1"] * 21) for link in result.links]
    file.write_text("\n".join(lines) + "\n")


def _write_keyframes(folder: Path, result: SurveyResult, rig: StereoRig) -> None:
    rng = np.random.default_rng(1)
    index = {
        "frames": result.keyframe_rows.tolist(),
        "tracks": result.track_of_keyframe.tolist(),
        "n_frames_per_keyframe": 8,
    }
    index |= {"position_cov_m2": position_cov_m2(result).tolist(), "link_residuals": link_residuals(result).tolist()}
    index["timing_ms"] = {"f2f": [12.0] * len(result.online), "stereo": [35.0] * len(result.keyframe_rows)}
    (folder / "index.json").write_text(json.dumps(index))
    ground = cv2.GaussianBlur(rng.normal(0, 1, (600, 900)), (0, 0), 1.5)
    ground = np.clip(110 + 45 * ground / ground.std(), 0, 255).astype(np.uint8)
    for k, frame in enumerate(result.keyframe_rows):
        view = np.roll(ground, (-k, -2 * k), (0, 1))[: rig.height_px // 4, : rig.width_px // 4]  # small: fast
        for side, tint in (("left", (0.6, 0.9, 0.8)), ("right", (0.6, 0.85, 0.8))):
            image = (view[..., None] * np.array(tint)).astype(np.uint8)
            cv2.imwrite(str(folder / f"{frame:06d}_{side}.png"), np.ascontiguousarray(image[..., ::-1]))
