"""Rerun recording of a survey (run.rrd) and live viewer. No other module imports rerun."""

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

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
from twin.report.run_folder import SCENARIO_FILE, Run, load_run
from twin.report.style import ESTIMATES, LABELS, rgb
from twin.scenario import file as scenario_file

#: Largest number of keyframes whose images are logged; longest side of these images and of the orthomosaic [px].
N_IMAGED, IMAGE_SIDE_PX, MOSAIC_PX = 500, 320, 1600
#: Largest number of snapshots of growing entities (paths, network, map), and of samples of a time series.
N_SNAPSHOTS, N_SAMPLES = 24, 5000

#: Command of the Rerun viewer; --bind makes it accept connections from this machine only.
VIEWER = (sys.executable, "-m", "rerun", "--bind", "127.0.0.1")
#: The true floor is translucent and lowered: it would flicker (z-fighting) where an accurate map coincides with it.
TRUTH_ALPHA, TRUTH_BELOW_M = 110, 0.03


class FrameTimes(NamedTuple):
    """Frame numbers (n,) and their times (n,) [s]."""

    frames: NDArray[np.int64]
    times_s: Array


def record_run(run: Run) -> Path:
    """Writes run.rrd into the folder of a run and returns its path."""
    file = run.folder / "run.rrd"
    rig = replayed_rig(run.scenario)
    if rig is None:  # no plug-in is loaded for it
        rig = scenario_file.load_scenario(run.folder / SCENARIO_FILE, allow_plugins=True).believed_rig()
    recording = rr.RecordingStream("twin", recording_id=run.folder.name)
    recording.save(file, default_blueprint=blueprint(_overview(run)))
    log_scene(recording, run)
    log_paths(recording, run)
    log_map(recording, run, rig)
    log_cameras(recording, run, rig)
    log_curves(recording, run)
    recording.flush()
    recording.disconnect()
    return file


def open_viewer(folder: Path) -> int:
    """Opens a run in the Rerun viewer and returns the viewer's exit status. Writes run.rrd first if it is missing."""
    file = Path(folder) / "run.rrd"
    if not file.is_file():
        record_run(load_run(folder))
    return subprocess.run([*VIEWER, str(file)], check=False).returncode


def blueprint(viewpoint: rrb.EyeControls3D | None = None) -> rrb.Blueprint:
    """Returns the layout of the viewer: 3-D view on the left; cameras, mosaic and curves on the right."""
    cameras = rrb.Horizontal(
        rrb.Spatial2DView(origin="/world/rig/left", name="Left camera"),
        rrb.Spatial2DView(origin="/world/rig/right", name="Right camera"),
    )
    pictures = rrb.Tabs(
        rrb.Spatial2DView(origin="/mosaic", name="Mosaic"), rrb.TextDocumentView(origin="/summary", name="Summary")
    )
    units = {"position": "m", "height": "m", "heading": "deg"}
    curves = rrb.Tabs(
        *[
            rrb.TimeSeriesView(origin=f"/error/{name}", name=f"{name.capitalize()} error [{unit}]")
            for name, unit in units.items()
        ]
    )
    timing = rrb.TimeSeriesView(origin="/timing", name="Time per call [ms]")
    survey = rrb.Spatial3DView(origin="/world", name="Survey", eye_controls=viewpoint)
    return rrb.Blueprint(
        rrb.Horizontal(survey, rrb.Vertical(cameras, pictures, curves, timing), column_shares=[3, 2]),
        rrb.TimePanel(state="collapsed", timeline="frame"),
        rrb.SelectionPanel(state="hidden"),
    )


def _overview(run: Run) -> rrb.EyeControls3D | None:
    """Returns a viewpoint above and south of the survey that shows all of it; None without a trajectory."""
    paths = [path.positions for path in run.trajectories.values() if len(path)]
    if not paths:
        return None
    low, high = (getattr(np.concatenate(paths), side)(axis=0) for side in ("min", "max"))
    target = np.array([*(low + high)[:2] / 2, low[2] / 2])
    distance = max(1.0, float(np.linalg.norm((high - low)[:2])))
    position = target + distance * np.array([0.0, -0.75, 0.9])
    return rrb.EyeControls3D(position=position, look_target=target, eye_up=[0, 0, 1])


def log_scene(recording: rr.RecordingStream, run: Run) -> None:
    """Logs the static entities: axes, summary and, where the run has them, true floor, planned path and orthomosaic."""
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
        planned = line(positions[:: stride(len(positions))], "reference")
        recording.log("world/path/reference", planned, static=True)
    if "mosaic" in run.rasters:
        recording.log("mosaic", jpeg(run.rasters["mosaic"].values, MOSAIC_PX), static=True)


def log_paths(recording: rr.RecordingStream, run: Run) -> None:
    """Logs the trajectories and the network at up to `N_SNAPSHOTS` times, each time the part up to then."""
    paths = {name: run.trajectories[name] for name in ("truth", *ESTIMATES) if name in run.trajectories}
    for name, path in paths.items():
        for end in np.unique(np.linspace(1, len(path), min(N_SNAPSHOTS, len(path))).astype(int)):
            _set_time(recording, end - 1, float(path.times_s[end - 1]))
            recording.log(f"world/path/{name}", line(path.positions[: end : stride(end)], name))
    for last, frame_and_time in snapshots(run):
        edges = run.network.edges[run.network.edges.max(axis=1) <= last]
        _set_time(recording, *frame_and_time)
        recording.log("world/network", segments(run.network.positions[edges], "link"))
    recording.reset_time()


def log_map(recording: rr.RecordingStream, run: Run, rig: StereoRig) -> None:
    """Logs the final elevation map; each part appears at the first snapshot whose keyframes observe it, if any."""
    if "dem" not in run.rasters or "final" not in run.trajectories or not len(run.keyframes.frames):
        return
    surface = recording_surfaces.map_surface(run.rasters["dem"], run.rasters.get("mosaic"))
    surface = recording_surfaces.in_world(surface, run.keyframes.map_from_world)
    steps = list(snapshots(run))
    poses = run.trajectories["final"].world_from_camera[run.keyframes.frames]
    groups = np.split(poses, [last + 1 for last, _ in steps])[:-1]
    first_observed = recording_surfaces.first_observed(surface.points, groups, rig)
    for number, (_, frame_and_time) in enumerate(steps):
        part = recording_surfaces.submesh(surface, first_observed, number)
        if len(part.triangles):
            _set_time(recording, *frame_and_time)
            recording.log(f"world/map/{number:02d}", surface_mesh(part))
    recording.reset_time()


def log_cameras(recording: rr.RecordingStream, run: Run, rig: StereoRig) -> None:
    """Logs the rig and its images along the true path, or along the online estimate if there is none."""
    name = "truth" if "truth" in run.trajectories else "online"
    if name not in run.trajectories or not len(run.trajectories[name]):
        return
    path = run.trajectories[name]
    rows = subsampled_rows(len(path))
    log_rig(recording, rig)
    poses = path.world_from_camera[rows]
    quaternions = [geometry.quaternion_xyzw(pose[:3, :3]) for pose in poses]
    columns = rr.Transform3D.columns(translation=poses[:, :3, 3], quaternion=quaternions)
    recording.send_columns("world/rig", time_columns(FrameTimes(rows, path.times_s[rows])), columns)
    frames = [frame for frame in run.frames_with_image() if frame < len(path)]
    shown = np.array(frames, dtype=np.int64)[:: stride(len(frames), N_IMAGED)]
    for side in ("left", "right"):
        _send_images(recording, run, side, FrameTimes(shown, path.times_s[shown]))


def _send_images(recording: rr.RecordingStream, run: Run, side: str, times: FrameTimes) -> None:
    images = (read_rgb(run.image_file(int(f), side)) for f in times.frames)  # one by one: 500 large ones take 3 GB
    encoded = [None if image is None else jpeg_bytes(image, IMAGE_SIDE_PX) for image in images]
    exists = np.array([data is not None for data in encoded], dtype=bool)
    if exists.any():
        data = [data for data in encoded if data is not None]
        columns = rr.EncodedImage.columns(blob=data, media_type=["image/jpeg"] * len(data))
        shown = FrameTimes(times.frames[exists], times.times_s[exists])
        recording.send_columns(f"world/rig/{side}", time_columns(shown), columns)


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


def log_curves(recording: rr.RecordingStream, run: Run) -> None:
    """Logs the errors of every estimate, if the true path is known, and the durations of the processing stages."""
    if "truth" in run.trajectories:
        for name in ESTIMATES:
            if name in run.trajectories:
                _log_errors(recording, run, name)
    for stage, (times, values) in stage_durations(run).items():
        log_curve(recording, f"timing/{stage}", times, values)
        if len(values) == 1:
            recording.log(f"timing/{stage}", rr.SeriesPoints(marker_sizes=4), static=True)


def _log_errors(recording: rr.RecordingStream, run: Run, name: str) -> None:
    errors, truth = run.errors(name), run.trajectories["truth"]
    rows = subsampled_rows(len(errors.travelled_m))
    times = FrameTimes(rows, truth.times_s[rows])
    log_curve(recording, f"error/position/{name}", times, errors.distance_m[rows], name)
    log_curve(recording, f"error/height/{name}", times, errors.position_m[rows, 2], name)
    log_curve(recording, f"error/heading/{name}", times, np.rad2deg(errors.heading_rad[rows]), name)


def log_curve(
    recording: rr.RecordingStream, entity: str, times: FrameTimes, values: Array, role: str | None = None
) -> None:
    """Logs one curve; `role` is the key of its colour and label, by default those of Rerun and the entity's name."""
    if len(values):
        style: dict[str, Any] = {"names": LABELS[role] if role else entity.split("/")[-1]}
        style |= {"colors": rgb(role)} if role else {}
        recording.log(entity, rr.SeriesLines(**style), static=True)
        recording.send_columns(entity, time_columns(times), rr.Scalars.columns(scalars=values))


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
        _set_time(self.recording, frame.index, frame.time_s)
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


def line(positions: Array, role: str) -> rr.LineStrips3D:
    return rr.LineStrips3D([positions.astype(np.float32)], colors=[colour(role)], radii=rr.Radius.ui_points(1.5))


def segments(pairs: Array, role: str) -> rr.LineStrips3D:
    return rr.LineStrips3D(pairs.astype(np.float32), colors=[colour(role)], radii=rr.Radius.ui_points(0.6))


def surface_mesh(surface: recording_surfaces.Surface, alpha: int = 255) -> rr.Mesh3D:
    """Returns a surface as a Rerun mesh; alpha is its opacity, 0 to 255."""
    return rr.Mesh3D(
        albedo_factor=(255, 255, 255, alpha),
        vertex_positions=surface.points, triangle_indices=surface.triangles, vertex_colors=surface.colours,
        vertex_normals=surface.normals,
    )  # fmt: skip


def jpeg(image: Image, longest_px: int) -> rr.EncodedImage:
    return rr.EncodedImage(contents=jpeg_bytes(image, longest_px), media_type="image/jpeg")


def time_columns(times: FrameTimes) -> list[rr.TimeColumn]:
    return [rr.TimeColumn("frame", sequence=times.frames), rr.TimeColumn("sim_time", duration=times.times_s)]


def _set_time(recording: rr.RecordingStream, frame: int, time_s: float) -> None:
    recording.set_time("frame", sequence=int(frame))
    recording.set_time("sim_time", duration=float(time_s))


def snapshots(run: Run) -> Iterator[tuple[int, tuple[int, float]]]:
    """Yields the last keyframe of each snapshot: (keyframe number, (frame number, time [s]))."""
    path, frames = run.trajectories.get("online"), run.keyframes.frames
    if path is None or not len(frames):
        return
    for k in np.unique(np.linspace(0, len(frames) - 1, min(N_SNAPSHOTS, len(frames))).astype(int)):
        yield int(k), (int(frames[k]), float(path.times_s[frames[k]]))


def stage_durations(run: Run) -> dict[str, tuple[FrameTimes, Array]]:
    """Returns, by stage, the frames of at most `N_SAMPLES` calls and their durations [ms]; "ga" is the alignment."""
    path = run.trajectories.get("online")
    if path is None:
        return {}
    keyframes = run.keyframes.frames
    frames_by_count = {len(keyframes): keyframes, len(path): np.arange(len(path))}
    timing_ms = run.keyframes.timing_ms
    durations = {s: (frames_by_count[len(v)], v) for s, v in timing_ms.items() if len(v) in frames_by_count}
    durations |= _alignment_durations(run)
    thin = {s: (f[:: stride(len(f))], v[:: stride(len(f))]) for s, (f, v) in durations.items()}
    return {stage: (FrameTimes(frames, path.times_s[frames]), values) for stage, (frames, values) in thin.items()}


def _alignment_durations(run: Run) -> dict[str, tuple[NDArray[np.int64], Array]]:
    """Returns {"ga": (frames, durations [ms])} of the global alignments, each at the last keyframe of its track."""
    keys, tracks = run.keyframes, (run.metrics or {}).get("tracks") or []
    timed = [(keys.frames[keys.tracks <= row["track"]], row["ga_ms"]) for row in tracks if row["ga_ms"] is not None]
    rows = [(frames[-1], ms) for frames, ms in timed if len(frames)]
    return {"ga": (np.array([f for f, _ in rows]), np.array([ms for _, ms in rows], dtype=float))} if rows else {}


def stride(n: int, limit: int = N_SAMPLES) -> int:
    """Returns the smallest stride with which at most `limit` of n items are kept."""
    return max(1, -(-n // limit))


def subsampled_rows(n: int) -> NDArray[np.int64]:
    return np.arange(0, n, stride(n))
