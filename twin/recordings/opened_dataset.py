"""A data set that is ready to be replayed: its calibration, truth, readings and first stereo pair, all checked."""

from collections.abc import Collection
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np

from twin.core.geometry import Array
from twin.core.records import Trajectory
from twin.core.settings import EstimatorSettings
from twin.core.user_files import is_file, resolved
from twin.datasets.calibration import SIGMAS, StereoCalibration
from twin.datasets.calibration_files import read_calibration
from twin.datasets.calibration_values import READ
from twin.datasets.dataset import Dataset, StereoImages
from twin.datasets.image_files import Bayer
from twin.datasets.readers import read_dataset
from twin.datasets.ros2.bag import is_bag
from twin.datasets.ros2.bag_reader import BagTopics
from twin.datasets.truth_files import read_true_map, read_truth
from twin.errors import TwinError
from twin.estimate.first_pair import FloorPlane, PairInspection, floor_plane, inspect_pair
from twin.judge.recorded import AlignmentName, TrueMap, associate
from twin.recordings.frames import RecordedFrames, increasing
from twin.recordings.recorded_aiding import Aiding
from twin.report.number_formats import length
from twin.report.run_writer import OPTIONAL_OUTPUTS

_DEPTHS_M = 0.1, 30.0  # plausible median depths of images under water
_FARTHEST_M = 1e8  # largest coordinate of a true position; in UTM and ECEF they are up to 1e7 m

T = TypeVar("T")


@dataclass(frozen=True)
class ReplayOptions:
    """Options of a replay."""

    calibration: Path | None = None  #: calibration file; None: that of the data set
    truth: Path | None = None  #: file of true poses, or topic of them in a ROS 2 bag; None: that of the data set
    alignment: AlignmentName = "first"  #: how the estimates are moved to the truth before the comparison
    bayer: Bayer | None = None  #: pattern of raw images; None: grey or colour images
    #: Settings of the estimators, of which `window_tracks` and `wide_search` are replaced; None: the defaults.
    settings: EstimatorSettings | None = None
    #: (4, 4) pose world_from_camera of the rectified left camera at the first frame; None: z is up by the recorded
    #: attitude or, without one, the plane z = 0 of the world is the floor plane of the first pair (`floor_plane`).
    start: Array | None = None
    #: Outputs in addition to metrics, trajectories and maps: "report", "recording".
    outputs: Collection[str] = OPTIONAL_OUTPUTS
    topics: tuple[str, str] | None = None  #: image topics (left, right) of a ROS 2 bag; None: its only stereo pair
    #: Estimator of another package ("module:Class" or the name of an entry point `twin.estimators`), from whose poses
    #: the map is built; None: the estimators of `twin.estimate`.
    estimator: str | None = None
    aiding: bool = True  #: whether recorded readings of pressure, attitude, DVL and IMU are used
    true_map: Path | None = None  #: GeoTIFF of true heights [m] in the frame of the true poses; None: of the data set
    #: Standard deviations of the rotation between the cameras (about each axis) and of the baseline since the
    #: calibration; above 0, yaw and baseline are estimated. None: those of the data set, 0 unless the twin exported it.
    rotation_sigma_deg: float | None = None
    baseline_sigma_mm: float | None = None
    imu: bool = False  #: whether the recorded IMU predicts the motion between frames
    #: Frames of the data set that are used, by their numbers from 0 in the order of its list.
    frames: slice = field(default_factory=lambda: slice(None))
    baseline_m: float | None = None  #: distance between the cameras, for other units than metres; None: its own
    fov_deg: float | None = None  #: horizontal field of view of the rectified images; None: that of `rectification`

    def with_sigmas(self, calibration: StereoCalibration) -> StereoCalibration:
        """Returns a calibration with the standard deviations that are given; raises TwinError if one is not valid."""
        given = {key: value for key in SIGMAS if (value := getattr(self, key)) is not None}
        for key, value in given.items():
            if not 0 <= value <= SIGMAS[key]:
                raise TwinError(key, f"{value:g}", f"0 to {SIGMAS[key]:g}")
        return replace(calibration, **given)


class OpenedDataset(NamedTuple):
    """A data set that is ready to be replayed."""

    name: str  #: name of its folder or file
    reader: str  #: name of the reader of its layout
    dataset: Dataset
    frames: RecordedFrames  #: its rectified frames
    truth: Trajectory | None  #: true poses of the rectified left camera, at times relative to the first frame
    pair: PairInspection  #: the first stereo pair
    plane: FloorPlane  #: floor plane of the first pair, in the axes of the left camera
    aiding: Aiding | None  #: readings of the navigation sensors; None if none were recorded or they are not wanted
    true_map: TrueMap | None = None  #: true heights in the frame of `truth`; None if they are not known

    @property
    def used_readings(self) -> list[str]:
        return [] if self.aiding is None else self.aiding.used

    @property
    def depth_note(self) -> str:
        """Returns a sentence on a depth that images under water cannot have; "" for any other depth."""
        depth_m, baseline_m = float(np.median(self.pair.points.xyz[:, 2])), self.pair.rig.baseline_m
        if _DEPTHS_M[0] <= depth_m <= _DEPTHS_M[1]:
            return ""
        problem = f"A median depth of {length(depth_m)} in the first pair is implausible under water"
        return f"{problem}: check the unit of the baseline ({length(baseline_m)}, --baseline)."

    @property
    def plane_text(self) -> str:
        """Returns a phrase that states how the plane of the map was chosen; a start in the options is ignored."""
        if "attitude" in self.used_readings:
            return "plane of the map horizontal by the recorded attitude"
        if "vertical" in self.used_readings:
            return "plane of the map horizontal by the recorded specific forces"
        return f"plane of the map {'fitted to the floor' if self.plane.fitted else 'perpendicular to the first view'}"


def open_dataset(folder: Path, options: ReplayOptions) -> OpenedDataset:
    """Returns a data set with its calibration, truth and readings, after checks of these and of its first stereo pair.

    Raises TwinError if the folder has no known layout, there is no calibration or no usable pair, fewer than 30 points
    of the first pair are matched, the cameras are swapped, the calibration or the truth does not fit the images, a file
    is damaged, or topics are named for a data set that is not a bag.
    """
    in_bag = options.truth is not None and is_bag(folder) and not is_file(options.truth)
    dataset, reader = read_dataset(folder, BagTopics(options.topics, str(options.truth) if in_bag else None))
    dataset = _forward(dataset)
    if options.topics is not None and not is_bag(folder):
        raise TwinError("--topics", f"{folder} is not a ROS 2 bag", "no topics for other data sets")
    calibration = dataset.calibration if options.calibration is None else read_calibration(options.calibration)
    if calibration is None:
        raise TwinError(str(folder), "has no calibration", f"--calibration FILE: {READ}")
    used = replace(dataset, images=dataset.images[options.frames])
    if not used.images:
        raise TwinError("--frames", "no frame of the data set is in this range", f"0 to {len(dataset.images) - 1}")
    calibration = options.with_sigmas(_sound(calibration).with_baseline(options.baseline_m))
    frames = RecordedFrames(used, calibration, options.bayer, options.fov_deg)
    truth = _truth(dataset, frames, None if in_bag else options.truth)
    pair = inspect_pair(frames.first_pair(), frames.rectification.rig, options.settings)
    plane = floor_plane(pair.points)
    if pair.swapped or (plane is None and _fits_exchanged(frames, calibration, options)):
        problem = "the left and the right images are swapped, or both upside down: the disparities are negative"
        raise TwinError(str(folder), problem, "left images of the camera on the left")
    if plane is None:
        problem = f"only {len(pair.points.xyz)} points of the first pair are matched"
        raise TwinError(str(folder), problem, "a rectified pair that fits the calibration; see `--preview`")
    readings = _sound(dataset.readings) if options.aiding else None
    aiding, rectified = None, frames.rectification
    if readings is not None:
        rate_hz = rectified.rig.frame_rate_hz
        aiding = Aiding(readings, rectified.left_from_rectified, frames.start_s, rate_hz, options.imu)
    elif options.imu:
        raise TwinError("--imu", "the data set has no readings that are used", "a data set with imu0, and --aiding")
    true_map = _true_map(dataset, truth, options)
    return OpenedDataset(resolved(folder).name, reader, dataset, frames, truth, pair, plane, aiding, true_map)


def _sound(value: T | TwinError) -> T:
    if isinstance(value, TwinError):
        raise value
    return value


def _forward(dataset: Dataset) -> Dataset:
    """Returns the data set in the order of time if its images are listed in the reverse order."""
    times_s = np.array([frame.time_s for frame in dataset.images])
    if increasing(times_s).sum() >= increasing(times_s[::-1]).sum():
        return dataset
    note = "The images are listed in the reverse order of time; they were replayed in the order of time."
    return replace(dataset, images=dataset.images[::-1], notes=(*dataset.notes, note))


def _fits_exchanged(frames: RecordedFrames, calibration: StereoCalibration, options: ReplayOptions) -> bool:
    """Returns whether the first pair is matched if each image is rectified as that of the other camera."""
    images = [StereoImages(one.time_s, one.right, one.left) for one in frames.dataset.images if one.right is not None]
    dataset = replace(frames.dataset, images=images)
    exchanged = RecordedFrames(dataset, calibration, options.bayer, options.fov_deg)
    rig = exchanged.rectification.rig
    return floor_plane(inspect_pair(exchanged.first_pair(), rig, options.settings).points) is not None


def _true_map(dataset: Dataset, truth: Trajectory | None, options: ReplayOptions) -> TrueMap | None:
    """Returns the true heights: those of the option, or those of the data set if the true poses are its own, too."""
    if options.true_map is None:
        own = dataset.true_map if options.truth is None and truth is not None else None
        return None if own is None else read_true_map(own)
    if truth is None:
        raise TwinError("--true-map", "the data set has no true poses, in whose frame the heights are", "--truth")
    return read_true_map(options.true_map)


def _truth(dataset: Dataset, frames: RecordedFrames, file: Path | None) -> Trajectory | None:
    """Returns true poses of the rectified left camera, relative to the first frame in time; None without a truth."""
    # TwinError if damaged, empty or impossible, or if none of several frames has a true pose (`associate`)
    truth, source = _sound(dataset.truth if file is None else read_truth(file, dataset)), str(file or dataset.folder)
    if truth is None:
        return None
    truth = _ordered(truth, source)
    poses = truth.world_from_camera @ frames.rectification.left_from_rectified
    moved = Trajectory(truth.times_s - frames.start_s, poses)
    times_s = np.array([frame.time_s for frame in frames.dataset.images]) - frames.start_s
    if len(times_s) > 1 and len(associate(times_s, moved.times_s).estimate) == 0:
        span = f"{truth.times_s.min():.3f} to {truth.times_s.max():.3f} s"
        given = f"{frames.start_s:.3f} to {frames.start_s + times_s.max():.3f} s"
        raise TwinError(source, f"the truth is of another clock: {span}", f"the times of the frames, {given}")
    return moved


def _ordered(truth: Trajectory, source: str) -> Trajectory:
    """Returns the true poses in the order of time; of several poses at the same time, only the first one is kept."""
    if not len(truth):
        raise TwinError(source, "the truth has no poses", "true poses at the times of the frames")
    largest_m = float(np.abs(truth.positions).max())
    if not largest_m <= _FARTHEST_M:
        raise TwinError(source, f"a coordinate of a true position is {largest_m:g} m", f"up to {_FARTHEST_M:g} m")
    times_s, first = np.unique(truth.times_s, return_index=True)
    return Trajectory(times_s, truth.world_from_camera[first])
