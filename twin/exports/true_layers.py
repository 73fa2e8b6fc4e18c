"""True layers of recorded frames: the images of the world are rendered again at the true poses of a run."""

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import NamedTuple
from zipfile import is_zipfile

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Array, Image, StereoRig
from twin.core.timing import Stopwatch
from twin.core.user_files import MOST_TEXT_BYTES, reading
from twin.datasets.run_contents import RecordedFrame
from twin.errors import TwinError
from twin.imaging.image_formation import ImageFormation
from twin.imaging.scene.facets import Heights
from twin.imaging.stereo_camera import DecomposedImage, StereoCamera
from twin.report.images import read_rgb
from twin.scenario.model import Scenario, SnowConfig, WaterConfig
from twin.world.mission import Mission, prepare
from twin.world.rendered_world import RenderedWorld

_N_COMPARED = 3  # frames from the start whose images are rendered again with their noise
_HIDDEN = 1.02  # a point is hidden in the next image if its depth exceeds this factor times all depths seen near it
_LIGHT = {"lamp": "floor_lx", "direct": "direct", "forward": "forward", "veil": "backscatter", "snow": "snow"}


class FrameTruth(NamedTuple):
    """True layers of one recorded left image: those of a pinhole camera with the believed calibration at its true pose.

    They are aligned with the recorded image if the scenario has no calibration error, lens distortion or port;
    otherwise, the image deviates from them by the error of its rectification.
    """

    frame: RecordedFrame  #: the recorded frame
    depth_m: NDArray[np.float32]  #: (H, W) depth along the optical axis; inf where there is neither floor nor object
    #: (H, W, 3) unit normals of floor and objects, towards the camera, in the axes of the left camera; zero where there
    #: is neither.
    normals: NDArray[np.float32]
    albedo: Image  #: (H, W, 3), 255 = white
    clean: Image  #: (H, W, 3) image in clear water without marine snow, by the same lamps and sensor, without noise
    #: components (H, W, 3) of the light by name, for the bands R, G, B: "lamp" (illuminance of the floor by lamps and
    #: daylight [lx]; NaN where there is no floor or the water transmits too little light to compute it), and the
    #: radiances [cd/m2] "direct" (light from the floor, not scattered on its way to the camera), "forward" (scattered
    #: on its way), "veil" (backscatter) and "snow" (change by marine snow). "forward" and "snow" exist only if the
    #: scenario has forward scatter and marine snow.
    light: Mapping[str, NDArray[np.float32]]
    labels: NDArray[np.uint16]  #: (H, W) number of the object at each pixel, from 1; 0: the floor, or nothing
    #: (H, W, 2) displacement (columns, rows) of each point to the next recorded image; NaN where there is no point, or
    #: it is outside the next image, hidden in it, or belongs to a swaying object; None for the last frame.
    flow_px: NDArray[np.float32] | None
    #: RMS of the recorded image minus f times the image rendered again without noise [grey levels], with the factor of
    #: exposure f that makes it smallest; values at full scale are left out.
    difference: float
    #: whether the image rendered again with its noise equals the recorded image; None if this was not compared.
    identical: bool | None


def true_layers(
    folder: Path, scenario: Scenario, frames: tuple[RecordedFrame, ...]
) -> tuple[list[str], Iterator[FrameTruth]]:
    """Returns the names of the objects, by label from 1, and the layers of the recorded frames, rendered when iterated.

    Raises TwinError where frames/truth.npz, which has the true poses, is damaged, or the scenario can no longer be
    prepared; while iterating, where a recorded image cannot be read or has another size than those of the run.
    """
    poses, twists = _true_motion(folder / "frames" / "truth.npz", max(frame.index for frame in frames))
    mission = prepare(scenario)
    kinds = [entry.shape for entry in scenario.objects]
    names = [f"{kinds[item.group]} (objects.{item.group})" for item in mission.objects]
    return names, _layers(mission, frames, poses, twists)


def _true_motion(file: Path, last: int) -> tuple[Array, Array]:
    """Returns true poses (n, 4, 4) of the left camera, body velocities (n, 6) [rad/s, m/s]; frames 0 to n > `last`."""
    with reading(file, "", "an undamaged file, written by `twin run`"):
        if not is_zipfile(file):
            raise ValueError("not an archive of NumPy")
        with np.load(file, allow_pickle=False) as arrays:
            if sum(info.file_size for info in arrays.zip.infolist()) > MOST_TEXT_BYTES:
                raise ValueError("its arrays are too large")
            poses, twists = np.asarray(arrays["world_from_camera"]), np.asarray(arrays["twist_body"])
        n = len(poses)
        if poses.shape != (n, 4, 4) or twists.shape != (n, 6) or n <= last:
            raise ValueError(f"{n} poses, {last + 1} needed")
        if not (np.isfinite(poses).all() and np.isfinite(twists).all()):
            raise ValueError("a pose or a velocity is not finite")
        return poses, twists


def _layers(mission: Mission, frames: tuple[RecordedFrame, ...], poses: Array, twists: Array) -> Iterator[FrameTruth]:
    """Yields the true layers of the frames, each after the next frame is rendered, which the optical flow needs."""
    sways = np.array([False, *(item.model.sways for item in mission.objects)])
    with RenderedWorld(mission, Stopwatch()) as world:
        clear = _camera_in_clear_water(mission, world)
        earlier = None
        for number, frame in enumerate(frames):
            pose, twist = poses[frame.index], twists[frame.index]
            recorded = _read(frame.left, mission.rig)
            identical = None
            if frame.index == number < _N_COMPARED:  # the noise of later frames depends on all frames before
                again = world.camera.capture(pose, frame.right is not None, twist).left
                identical = bool(np.array_equal(again, recorded))
            view = world.camera.decompose(pose, twist, frame.time_s)
            truth = _truth(mission, frame, view, pose, (recorded, identical))
            in_clear_water = np.nan_to_num(clear.decompose(pose, twist, frame.time_s).noise_free, nan=0.0)
            truth = truth._replace(clean=np.clip(np.round(in_clear_water), 0, 255).astype(np.uint8))
            if earlier is not None:
                before, pose_before = earlier
                moved = geometry.inverse(pose) @ pose_before
                flow_px = optical_flow(before.depth_m, truth.depth_m, moved, mission.rig)
                flow_px[sways[before.labels]] = np.nan
                yield before._replace(flow_px=flow_px)
            earlier = truth, pose
        if earlier is not None:
            yield earlier[0]


def _truth(
    mission: Mission, frame: RecordedFrame, view: DecomposedImage, world_from_camera: Array,
    compared: tuple[Image, bool | None],
) -> FrameTruth:  # fmt: skip
    """Returns the layers of one frame, without `flow_px` and `clean`, which the caller replaces."""
    # `view` is the left image, rendered again; `compared` the recorded one, and `FrameTruth.identical`
    recorded, identical = compared
    normals = floor_normals(mission.rendered_terrain, view.depth, world_from_camera, mission.rig)
    labels = np.zeros(view.depth.shape, np.uint16)
    if view.objects is not None:
        labels = view.objects.label
        normals = np.where(labels[..., None] > 0, view.objects.normal, normals)
        floor_tiles = labels > len(mission.objects)  # of a mesh floor
        labels = np.where(floor_tiles, np.uint16(0), labels)
    light = {name: getattr(view.components, key) for name, key in _LIGHT.items()}
    return FrameTruth(
        frame, view.depth, normals, view.albedo, view.albedo,
        {name: layer for name, layer in light.items() if layer is not None}, labels, None,
        _difference(recorded, view.noise_free), identical,
    )  # fmt: skip


def _difference(recorded: Image, noise_free: Image) -> float:
    """Returns the RMS of an image minus a factor times its rendering [grey levels], below full scale in both, or 0."""
    # The factor, which makes it smallest, stands for the delay of auto-exposure, which the rendering lacks.
    below = (recorded < 255) & (noise_free < 255)
    seen, rendered = recorded[below].astype(np.float64), noise_free[below].astype(np.float64)
    if not len(seen):
        return 0.0
    factor = float(seen @ rendered) / max(float(rendered @ rendered), 1.0)
    return float(np.sqrt(np.mean((seen - factor * rendered) ** 2)))


def _camera_in_clear_water(mission: Mission, world: RenderedWorld) -> StereoCamera:
    from twin.imaging.light.illumination import illumination_of

    clear = {"water": WaterConfig(jerlov="clear"), "snow": SnowConfig()}
    scenario = mission.scenario.model_copy(update=clear)
    rig, rng = mission.true_cameras.rendered_rig, np.random.default_rng(0)
    floor, objects = mission.rendered_terrain, mission.rendered_objects()
    light = ImageFormation(scenario, illumination_of(scenario), floor, rng, rig, objects)
    return StereoCamera(world.renderer, light, scenario, rng, rng, Stopwatch(), mission.true_cameras)


def floor_normals(
    terrain: Heights, depth_m: NDArray[np.float32], world_from_camera: Array, rig: StereoRig
) -> NDArray[np.float32]:
    """Returns the unit normals (H, W, 3) of the floor in the axes of the camera; 0 where `depth_m` (H, W) is inf."""
    # of the south-eastern or the north-western triangle of the cell of the height grid
    known = np.isfinite(depth_m)
    points = geometry.transform(world_from_camera, _points(np.where(known, depth_m, 1.0), rig).reshape(-1, 3))
    grid = (points[:, :2] - [terrain.west_m, terrain.south_m]) / terrain.spacing_m
    height, (ny, nx) = terrain.height_m.astype(np.float64), terrain.height_m.shape
    c, r = (np.clip(np.floor(grid[:, k]).astype(int), 0, n - 2) for k, n in ((0, nx), (1, ny)))
    south_west, south_east = height[r, c], height[r, c + 1]
    north_west, north_east = height[r + 1, c], height[r + 1, c + 1]
    in_south_east = grid[:, 0] - c >= grid[:, 1] - r
    east = np.where(in_south_east, south_east - south_west, north_east - north_west)
    north = np.where(in_south_east, north_east - south_east, north_west - south_west)
    normal = np.column_stack([-east, -north, np.full(len(east), terrain.spacing_m)])
    normal = normal / np.linalg.norm(normal, axis=1, keepdims=True) @ world_from_camera[:3, :3]
    return np.where(known[..., None], normal.reshape(*depth_m.shape, 3), 0.0).astype(np.float32)


def optical_flow(
    depth_m: NDArray[np.float32], next_depth_m: NDArray[np.float32], next_from_camera: Array, rig: StereoRig
) -> NDArray[np.float32]:
    """Returns the displacements (H, W, 2) (columns, rows) [px] of the points of a static scene to the next image.

    They are NaN where there is nothing (depth inf), where the point is outside the next image, and where it is hidden
    there, i.e. more than 2 % deeper than all 3 x 3 pixels around it. `next_from_camera` (4, 4) is the pose of this
    camera in the next.
    """
    shape = depth_m.shape
    known = np.isfinite(depth_m).ravel()
    points = _points(np.where(np.isfinite(depth_m), depth_m, 1.0), rig).reshape(-1, 3)
    moved = geometry.transform(next_from_camera, points)
    pixels = rig.project(moved)
    rows, cols = np.indices(shape)
    flow = pixels.reshape(*shape, 2) - np.stack([cols, rows], -1)
    nearest = np.round(np.nan_to_num(pixels, nan=-1.0)).astype(int)
    inside = (nearest >= 0).all(axis=1) & (nearest < [rig.width_px, rig.height_px]).all(axis=1)
    column, row = np.clip(nearest, 0, [rig.width_px - 1, rig.height_px - 1]).T
    farthest = cv2.dilate(np.asarray(next_depth_m, np.float32), np.ones((3, 3), np.uint8))
    seen = inside & known & (moved[:, 2] <= _HIDDEN * farthest[row, column])
    return np.where(seen.reshape(shape)[..., None], flow, np.nan).astype(np.float32)


def _points(depth_m: NDArray[np.floating], rig: StereoRig) -> Array:
    """Returns the points (H, W, 3) at the pixels of a depth image (H, W) in the axes of the camera [m]."""
    rows, cols = np.indices(depth_m.shape)
    pixels = np.stack([cols, rows], -1).reshape(-1, 2).astype(np.float64)
    directions = np.column_stack([rig.normalised(pixels), np.ones(len(pixels))])
    return directions.reshape(*depth_m.shape, 3) * depth_m[..., None]


def _read(file: Path, rig: StereoRig) -> Image:
    image = read_rgb(file)
    if image is None:
        raise TwinError(str(file), "cannot be read", "a PNG, written by `twin run`")
    if image.shape[1::-1] != (rig.width_px, rig.height_px):
        size = f"{rig.width_px} x {rig.height_px} px, the size of the images of the run"
        raise TwinError(str(file), f"is {image.shape[1]} x {image.shape[0]} px", size)
    return image
