"""Rerun recording of a survey (run.rrd) and live viewer. No other module imports rerun."""

import json
import os
import signal
import subprocess
import sys
from contextlib import suppress
from itertools import product
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Array, Estimate, Frame, Image, StereoRig
from twin.report import recording_surfaces
from twin.report.headline import badge, first_lines, headline, key_figures
from twin.report.images import jpeg_bytes, read_rgb
from twin.report.replay_description import replayed_rig
from twin.report.run_files import conform
from twin.report.run_folder import SCENARIO_FILE, Run, load_run
from twin.report.style import ESTIMATES, LABELS, rgb
from twin.scenario import file as scenario_file

#: Largest number of keyframes with images, and of images sent at once; longest side of these and the orthomosaic [px].
N_IMAGED, N_SENT, IMAGE_SIDE_PX, MOSAIC_PX = 200, 50, 320, 1600
#: Largest number of snapshots of growing entities (paths, network, map), samples of a curve, and ellipsoids.
N_SNAPSHOTS, N_SAMPLES, N_ELLIPSOIDS = 24, 5000, 200
#: Half axes of the ellipsoids [standard deviations], and the largest one drawn as a share of the extent of the path.
N_SIGMA, LARGEST = 2, 0.02
#: Names of the views of curves, by the entity above these curves.
CURVES = {
    "error/position": "Position error [m]", "error/height": "Height error [m]", "error/heading": "Heading error [deg]",
    "attitude/roll": "Roll [deg]", "attitude/pitch": "Pitch [deg]", "attitude/heading": "Heading [deg]",
    "thrust": "Thrust [N]",
}  # fmt: skip

#: Command of the Rerun viewer; --bind makes it accept connections from this machine only.
VIEWER = (sys.executable, "-m", "rerun", "--bind", "127.0.0.1")
#: The true floor is translucent and lowered: it would flicker (z-fighting) where an accurate map coincides with it.
TRUTH_ALPHA, TRUTH_BELOW_M = 110, 0.03


def record_run(run: Run) -> Path:
    """Writes run.rrd into the folder of a run and returns its path."""
    file = run.folder / "run.rrd"
    rig = replayed_rig(run.scenario)
    if rig is None:  # no plug-in is loaded for it
        rig = scenario_file.load_scenario(run.folder / SCENARIO_FILE, allow_plugins=True).believed_rig()
    recording = rr.RecordingStream("twin", recording_id=run.folder.name)
    recording.save(file, default_blueprint=blueprint(_overview(run)))
    log_scene(recording, run)
    if len(run.times_s):
        log_paths(recording, run)
        log_network(recording, run)
        log_map(recording, run, rig)
        log_cameras(recording, run, rig)
        log_curves(recording, run, rig)
        log_events(recording, run)
    recording.flush()
    recording.disconnect()
    return file


def open_viewer(folder: Path, web: bool = False) -> int:
    """Opens a run in the Rerun viewer, with `web` in a browser, until it is closed; returns its exit status.

    Writes run.rrd first if it is missing. A KeyboardInterrupt ends the viewer.
    """
    file = Path(folder) / "run.rrd"
    if not file.is_file():
        record_run(load_run(folder))
    with subprocess.Popen([*VIEWER, *(["--web-viewer"] if web else []), str(file)], start_new_session=True) as viewer:
        try:
            return viewer.wait()
        except KeyboardInterrupt:
            os.killpg(viewer.pid, signal.SIGTERM)
    print(f"Closed {file}")
    return 0


def blueprint(viewpoint: rrb.EyeControls3D | None = None) -> rrb.Blueprint:
    """Returns the layout of the viewer: 3-D view on the left; cameras, mosaic and curves on the right."""
    sides = {"left": "Left camera", "right": "Right camera"}
    cameras = rrb.Horizontal(*[rrb.Spatial2DView(origin=f"/world/rig/{s}", name=name) for s, name in sides.items()])
    pictures = rrb.Tabs(
        rrb.Spatial2DView(origin="/mosaic", name="Mosaic"), rrb.TextDocumentView(origin="/summary", name="Summary"),
        rrb.TextLogView(origin="/events", name="Events"),
    )  # fmt: skip
    views = rrb.Tabs(*[rrb.TimeSeriesView(origin=f"/{origin}", name=name) for origin, name in CURVES.items()])
    timing = rrb.Horizontal(  # on axes of their own, as an alignment takes much longer than a frame
        rrb.TimeSeriesView(origin="/timing", contents=["$origin/**", "- $origin/ga"], name="Time per call [ms]"),
        rrb.TimeSeriesView(origin="/timing/ga", name="Time per global alignment [ms]"),
    )
    survey = rrb.Spatial3DView(origin="/world", name="Survey", eye_controls=viewpoint)
    return rrb.Blueprint(
        rrb.Horizontal(survey, rrb.Vertical(cameras, pictures, views, timing), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="frame", play_state="following"),
        rrb.SelectionPanel(state="hidden"),
    )


def _overview(run: Run) -> rrb.EyeControls3D | None:
    """Returns a viewpoint above and south of the survey that shows all paths and the map; None without a trajectory."""
    points = [path.positions for path in run.trajectories.values() if len(path)]
    if not points:
        return None
    if "dem" in run.rasters:
        heights, (x, y) = run.rasters["dem"].values[::9, ::9], run.rasters["dem"].grid.centres()
        cells = np.stack([*np.meshgrid(x[::9], y[::9]), heights], axis=-1)[np.isfinite(heights)]
        points.append(geometry.transform(geometry.inverse(run.keyframes.map_from_world), cells))
    low, high = (getattr(np.concatenate(points), side)(axis=0) for side in ("min", "max"))
    target, radius = (low + high) / 2, max(0.5, float(np.linalg.norm(high - low)) / 2)
    position = target + 2.4 * radius * np.array([0.0, -0.6, 0.8])  # the viewer's field of view is 55 deg high
    return rrb.EyeControls3D(position=position, look_target=target, eye_up=[0, 0, 1])


def log_scene(recording: rr.RecordingStream, run: Run) -> None:
    """Logs the static entities: axes, summary and, where the run has them, true floor and planned path."""
    recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    summary = "\n".join(
        [f"# {run.scenario.get('name', run.folder.name)}: {badge(run.metrics).text}", ""]
        + [f"- {sentence}" for sentence in (first_lines(run.metrics) if run.metrics else ())]
        + ["", headline(run.metrics, run.scenario), ""]
        + [f"- **{row.label}**: {row.value} ({row.meaning})" for row in key_figures(run.metrics or {})]
    )
    recording.log("summary", rr.TextDocument(summary, media_type=rr.MediaType.MARKDOWN), static=True)
    if "dem_truth" in run.rasters and np.allclose(run.keyframes.map_from_world, np.eye(4)):
        floor = recording_surfaces.floor_surface(run.rasters["dem_truth"])
        recording.log("world/true_floor", rr.Transform3D(translation=(0, 0, -TRUTH_BELOW_M)), static=True)
        recording.log("world/true_floor", surface_mesh(floor, alpha=TRUTH_ALPHA), static=True)
    if "reference" in run.trajectories:
        positions = run.trajectories["reference"].positions
        recording.log("world/path/reference", line(positions[:: stride(len(positions))], "reference"), static=True)


def log_paths(recording: rr.RecordingStream, run: Run) -> None:
    """Logs the trajectories at up to `N_SNAPSHOTS` times, each time the part up to then."""
    paths = {name: run.trajectories[name] for name in ("truth", *ESTIMATES) if name in run.trajectories}
    for name, path in paths.items():
        for last in snapshots(len(path)):
            _set_time(recording, run, last)
            recording.log(f"world/path/{name}", line(path.positions[: last + 1 : stride(last)], name))


def log_network(recording: rr.RecordingStream, run: Run) -> None:
    """Logs at each snapshot its new links, and the ellipsoids of some keyframes so far, enlarged as their name says."""
    keys, (positions, edges) = run.keyframes, run.network
    residuals = keys.link_residuals if len(keys.link_residuals) == len(edges) else np.zeros(len(edges))
    shown = np.arange(0, min(len(keys.position_cov_m2), len(positions)), stride(len(positions), N_ELLIPSOIDS))
    half_axes_m, quaternions = ellipsoids(keys.position_cov_m2[shown])
    factor = enlargement(half_axes_m, np.linalg.norm(positions - positions[:1], axis=1).max(initial=0))
    steps = snapshots(len(keys.frames))
    first_seen = np.searchsorted(steps, edges.max(axis=1))  # snapshot of each link
    for number, last in enumerate(steps):
        _set_time(recording, run, keys.frames[last])
        links, n = first_seen == number, np.searchsorted(shown, last, side="right")
        strips, colours = positions[edges[links]].astype(np.float32), residual_colours(residuals[links])
        lines = rr.LineStrips3D(strips, colors=colours, radii=rr.Radius.ui_points(0.6))
        recording.log(f"world/network/{number:02d}", lines)
        if n:
            at, half_axes, turns = positions[shown[:n]], factor * half_axes_m[:n], quaternions[:n]
            some = rr.Ellipsoids3D(centers=at, half_sizes=half_axes, quaternions=turns, colors=rgb("final"))
            recording.log(f"world/position_{N_SIGMA}_sigma_times_{factor}", some)


def log_map(recording: rr.RecordingStream, run: Run, rig: StereoRig) -> None:
    """Logs the final elevation map, each part at the first snapshot whose keyframes observe it, and the orthomosaic."""
    if "mosaic" in run.rasters:
        _set_time(recording, run, len(run.times_s) - 1)  # it is not known before
        recording.log("mosaic", jpeg(run.rasters["mosaic"].values, MOSAIC_PX))
    frames = run.keyframes.frames
    if "dem" not in run.rasters or "final" not in run.trajectories or not len(frames):
        return
    surface = recording_surfaces.map_surface(run.rasters["dem"], run.rasters.get("mosaic"))
    surface = recording_surfaces.in_world(surface, run.keyframes.map_from_world)
    steps = snapshots(len(frames))
    groups = np.split(run.trajectories["final"].world_from_camera[frames], [last + 1 for last in steps])[:-1]
    first_observed = recording_surfaces.first_observed(surface.points, groups, rig)
    for number, last in enumerate(steps):
        part = recording_surfaces.submesh(surface, first_observed, number)
        if len(part.triangles):
            _set_time(recording, run, frames[last])
            recording.log(f"world/map/{number:02d}", surface_mesh(part))


def log_cameras(recording: rr.RecordingStream, run: Run, rig: StereoRig) -> None:
    """Logs the rig and its images along the true path, or along the online estimate if there is none."""
    path = run.trajectories.get("truth", run.trajectories.get("online"))
    if path is None:
        return
    rows = np.arange(0, len(path), stride(len(path)))
    log_rig(recording, rig)
    poses = path.world_from_camera[rows]
    columns = rr.Transform3D.columns(
        translation=poses[:, :3, 3], quaternion=geometry.quaternions_xyzw(poses[:, :3, :3])
    )
    recording.send_columns("world/rig", time_columns(run, rows), columns)
    frames = [frame for frame in run.frames_with_image() if frame < len(path)]
    frames = frames[:: stride(len(frames), N_IMAGED)]
    for side, first in product(("left", "right"), range(0, len(frames), N_SENT)):
        images = ((frame, read_rgb(run.image_file(frame, side))) for frame in frames[first : first + N_SENT])
        blobs = {frame: jpeg_bytes(image, IMAGE_SIDE_PX) for frame, image in images if image is not None}
        if blobs:
            columns = rr.EncodedImage.columns(blob=list(blobs.values()), media_type=["image/jpeg"] * len(blobs))
            recording.send_columns(f"world/rig/{side}", time_columns(run, np.array(list(blobs))), columns)


def log_rig(recording: rr.RecordingStream, rig: StereoRig) -> None:
    """Logs the two cameras in the axes of the left one; the calibration is scaled to the logged images."""
    scale = min(1.0, IMAGE_SIDE_PX / max(rig.width_px, rig.height_px))
    camera = rr.Pinhole(
        image_from_camera=np.diag([scale, scale, 1.0]) @ rig.matrix,
        resolution=[round(rig.width_px * scale), round(rig.height_px * scale)],
        camera_xyz=rr.ViewCoordinates.RDF,
        image_plane_distance=0.4,
    )
    recording.log("world/rig/left", camera, static=True)
    recording.log("world/rig/right", rr.Transform3D(translation=rig.left_from_right[:3, 3]), camera, static=True)


def log_curves(recording: rr.RecordingStream, run: Run, rig: StereoRig) -> None:
    """Logs attitude and, where the truth is known, errors of all paths, and the durations of the stages."""
    down = geometry.BODY_FROM_DOWN_CAMERA if "replay" in run.scenario else rig.body_from_camera[:3, :3]
    for name in ("truth", *ESTIMATES):
        if (path := run.trajectories.get(name)) is not None:
            frames = np.arange(0, len(path), stride(len(path)))
            bodies = path.world_from_camera[frames, :3, :3] @ down.T
            angles = np.array([geometry.rpy_from_rotation(body) for body in bodies]).reshape(-1, 3)
            for angle, values in zip(("roll", "pitch", "heading"), np.unwrap(angles, axis=0).T, strict=True):
                log_curve(recording, run, f"attitude/{angle}/{name}", frames, np.rad2deg(values), name)
            if name != "truth" and "truth" in run.trajectories:
                errors = run.errors(name)
                frames, heading_deg = np.arange(len(errors.travelled_m)), np.rad2deg(errors.heading_rad)
                log_curve(recording, run, f"error/position/{name}", frames, errors.distance_m, name)
                log_curve(recording, run, f"error/height/{name}", frames, errors.position_m[:, 2], name)
                log_curve(recording, run, f"error/heading/{name}", frames, heading_deg, name)
    for number, thrust_n in enumerate(_thrusts_n(run.folder / "frames" / "truth.npz").T, start=1):
        log_curve(recording, run, f"thrust/{number}", np.arange(len(thrust_n)), thrust_n)
    for stage, (frames, values) in stage_durations(run).items():
        log_curve(recording, run, f"timing/{stage}", frames, values)


def _thrusts_n(file: Path) -> Array:
    """Returns the true thrust (frames, n) of each thruster [N]; empty if it was not recorded."""
    with suppress(OSError, EOFError, ValueError, KeyError, BadZipFile), np.load(file) as arrays:
        return arrays["thrust_n"]
    return np.zeros((0, 0))


def log_curve(
    recording: rr.RecordingStream, run: Run, entity: str, frames: NDArray[np.int64], values: Array, role: str = ""
) -> None:
    """Logs one curve; `role` is the key of its colour and label, by default those of Rerun and the entity's name."""
    if len(values):
        style: dict[str, Any] = {"names": LABELS[role] if role else entity.split("/")[-1]}
        style |= {"colors": colour(role)} if role else {}
        recording.log(entity, rr.SeriesLines(**style), static=True)
        if len(values) == 1:
            recording.log(entity, rr.SeriesPoints(marker_sizes=4), static=True)
        thin = slice(None, None, stride(len(values)))
        recording.send_columns(entity, time_columns(run, frames[thin]), rr.Scalars.columns(scalars=values[thin]))


def log_events(recording: rr.RecordingStream, run: Run) -> None:
    """Logs the events of the log, each at its time, at the end of its track or, without both, at the end."""
    file, keys = run.folder / "log.jsonl", run.keyframes
    for text in file.read_text("utf-8", "replace").splitlines() if file.is_file() else ():
        with suppress(ValueError):  # an incomplete line: the survey was killed, or the disk full
            event = {"event": ""} | conform(json.loads(text), {"event": "", "time_s": 0.0, "track": 0})
            of_track = keys.frames[keys.tracks <= event.get("track", 0)]
            at = np.searchsorted(run.times_s[:-1], event.get("time_s", np.inf))
            _set_time(recording, run, of_track[-1] if len(of_track) else at)
            texts = [f"{k} {v:.4g}" if isinstance(v, float) else f"{k} {v}" for k, v in event.items()]
            usual = event["event"] in ("started", "aligned", "complete") or event.get("status") == "ok"
            recording.log("events", rr.TextLog(", ".join(texts), level="INFO" if usual else "WARN"))


class LiveViewer:
    """Rerun viewer that shows images, estimated pose and estimated path during the survey."""

    def __init__(self, rig: StereoRig, recording: rr.RecordingStream | None = None) -> None:
        """Starts the viewer, or logs to the given recording without starting one."""
        self.recording = recording or rr.RecordingStream("twin_live")
        self.path: list[Array] = []
        if recording is None:
            subprocess.Popen(VIEWER, start_new_session=True)
            self.recording.connect_grpc(default_blueprint=blueprint())
        self.recording.log("world", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        log_rig(self.recording, rig)

    def log_frame(self, frame: Frame, estimate: Estimate) -> None:
        """Logs pose and sigma of a frame; for a frame with a stereo pair, also the images and the path so far."""
        pose = estimate.world_from_camera
        self.recording.set_time("frame", sequence=frame.index)
        self.recording.set_time("sim_time", duration=frame.time_s)
        quaternion = rr.Quaternion(xyzw=geometry.quaternion_xyzw(pose[:3, :3]))
        self.recording.log("world/rig", rr.Transform3D(translation=pose[:3, 3], quaternion=quaternion))
        self.recording.log("error/position/sigma", rr.Scalars(estimate.sigma_m))
        if frame.right is not None:
            self.path.append(pose[:3, 3].copy())
            self.recording.log("world/path/online", line(np.array(self.path), "online"))
            self.recording.log("world/rig/left", jpeg(frame.left, IMAGE_SIDE_PX))
            self.recording.log("world/rig/right", jpeg(frame.right, IMAGE_SIDE_PX))


def colour(role: str) -> tuple[int, int, int]:
    """Returns the RGB colour of a role (see `style.COLOURS`); near white for the truth, as the background is dark."""
    return (245, 245, 245) if role == "truth" else rgb(role)


def ellipsoids(cov: Array) -> tuple[Array, Array]:
    """Returns half axes (n, 3) [m] and orientations (n, 4) (xyzw) of ellipsoids of covariances (n, 3, 3) [m^2]."""
    variances, axes = np.linalg.eigh(cov)
    axes[..., 0] *= np.linalg.det(axes)[:, None]  # a rotation
    return N_SIGMA * np.sqrt(np.maximum(variances, 0)), geometry.quaternions_xyzw(np.ascontiguousarray(axes))


def enlargement(half_axes_m: Array, extent_m: float) -> int:
    """Returns the largest of 1, 10, ..., 10000 with which no half axis exceeds the share `LARGEST` of the extent."""
    ratio = LARGEST * max(extent_m, 1e-9) / half_axes_m.max(initial=1e-9)
    return 10 ** int(np.clip(np.floor(np.log10(ratio)), 0, 4))


def residual_colours(residuals: Array) -> Image:
    """Returns RGB colours (m, 3) of normalised residuals of links: grey up to 1, red from 3."""
    share = np.clip((residuals - 1) / 2, 0, 1)[:, None]
    return np.round((1 - share) * rgb("link") + share * rgb("limit")).astype(np.uint8)


def line(positions: Array, role: str) -> rr.LineStrips3D:
    return rr.LineStrips3D([positions.astype(np.float32)], colors=[colour(role)], radii=rr.Radius.ui_points(1.5))


def surface_mesh(surface: recording_surfaces.Surface, alpha: int = 255) -> rr.Mesh3D:
    """Returns a surface as a Rerun mesh; alpha is its opacity, 0 to 255."""
    return rr.Mesh3D(
        albedo_factor=(255, 255, 255, alpha),
        vertex_positions=surface.points, triangle_indices=surface.triangles, vertex_colors=surface.colours,
        vertex_normals=surface.normals,
    )  # fmt: skip


def jpeg(image: Image, longest_px: int) -> rr.EncodedImage:
    return rr.EncodedImage(contents=jpeg_bytes(image, longest_px), media_type="image/jpeg")


def time_columns(run: Run, frames: NDArray[np.int64]) -> list[rr.TimeColumn]:
    return [rr.TimeColumn("frame", sequence=frames), rr.TimeColumn("sim_time", duration=run.times_s[frames])]


def _set_time(recording: rr.RecordingStream, run: Run, frame: int | np.int64) -> None:
    recording.set_time("frame", sequence=int(frame))
    recording.set_time("sim_time", duration=float(run.times_s[frame]))


def snapshots(n: int) -> list[int]:
    """Returns at most `N_SNAPSHOTS` of the indices 0 to n - 1, evenly distributed, with the last one."""
    return np.unique(np.linspace(0, n - 1, min(N_SNAPSHOTS, n)).astype(int)).tolist()


def stage_durations(run: Run) -> dict[str, tuple[NDArray[np.int64], Array]]:
    """Returns, by stage, the frames of its calls and their durations [ms]; "ga" is at the last keyframe of a track."""
    keys, tracks = run.keyframes, (run.metrics or {}).get("tracks") or []
    frames_by_count = {len(f): f for f in (keys.frames, np.arange(len(run.trajectories.get("online", ()))))}
    found = {s: (frames_by_count[len(v)], v) for s, v in keys.timing_ms.items() if len(v) in frames_by_count}
    timed = [(keys.frames[keys.tracks <= row["track"]], row["ga_ms"]) for row in tracks if row["ga_ms"] is not None]
    rows = [(frames[-1], ms) for frames, ms in timed if len(frames)]
    return found | {"ga": (np.array([frame for frame, _ in rows]), np.array([ms for _, ms in rows], float))}


def stride(n: int, limit: int = N_SAMPLES) -> int:
    """Returns the smallest stride with which at most `limit` of n items are kept."""
    return max(1, -(-n // limit))
