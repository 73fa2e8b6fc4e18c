from collections.abc import Callable, Sequence
from typing import Protocol

from twin.core.geometry import Array
from twin.core.quality import EpipolarError
from twin.core.records import ElevationMap, Frame, Image, MapGrid, StereoObservation, SurveyResult
from twin.estimate.vision.mosaic import Registration
from twin.estimate.vision.stereo import Keyframe, StereoPoints
from twin.estimate.vision.two_view_motion import Motion


class Vision(Protocol):
    """Visual measurements for `pipeline.Navigator`: from images (`stereo_vision.StereoVision`), or an error model.

    Poses are (4, 4) world_from_camera, left. Methods raise OSError if images or the mosaic cannot be read or written.
    """

    runs_in_background: bool  #: whether `measure_motions` takes long enough to justify a separate thread
    stereo_observations: list[StereoObservation]  #: image quality and number of points of every stereo pair so far

    def track_frame(self, frame: Frame) -> tuple[Motion, str]:
        """Returns the F2F motion since the last frame, and "ok" or why it failed; ValueError for a wrong image size.

        Where it failed, the motion is predicted; the next measured one is such that their product is the measured
        motion since the last frame before, unless a keyframe restarted the tracking.
        """
        ...

    def observe_stereo(self, frame: Frame, row: int) -> StereoPoints | None:
        """Returns the matched points of the pair at frame index `row`; None if there are too few for a keyframe."""
        ...

    def tracking_cov(self) -> Array | None:
        """Returns the covariance (6, 6) of the last frame's pose in the last keyframe by F2F; None where unknown.

        Errors are motions [rotation, translation] (rad, m) in the axes of the last frame.
        """
        ...

    def restart_tracking(self, velocity: Array | None = None) -> None:
        """Restarts F2F tracking from the latest keyframe."""
        ...

    def register_with_mosaic(self, world_from_camera: Array) -> Registration | None:
        """Returns the correction by F2M of the latest keyframe's predicted pose; None if the registration fails."""
        ...

    def add_to_mosaic(self, number: int, world_from_camera: Array) -> None:
        """Adds the latest keyframe, whose number is `number`, to the mosaic at the given pose."""
        ...

    def rebuild_mosaic(self, keyframes: Sequence[Keyframe]) -> None:
        """Clears the mosaic and rebuilds it from the given keyframes, the most recent ones, at their current poses."""
        ...

    def measure_motions(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Motion | None]:
        """Returns the motion from each of the other nodes to `node`, None where it fails; also from another thread."""
        ...

    def epipolar_error(self) -> EpipolarError | None:
        """Returns the estimated errors of the rectification; None if row differences are not measured."""
        ...

    def correct_yaw(self, yaw_rad: float, sigma_rad: float) -> None:
        """Corrects the right images from now on for a yaw of the right camera and its standard deviation [rad]."""
        ...

    def discard(self, numbers: range) -> None:
        """Frees the memory of the keyframes with these numbers, for which `measure_motions` is not called any more."""
        ...

    def build_map(
        self, result: SurveyResult, grid: MapGrid, step_cov: Array, progress: Callable[[int], None]
    ) -> ElevationMap:
        """Builds the elevation map along the final trajectory.

        Args:
            step_cov: (n_keyframes, 6, 6) covariance of the pose of each keyframe relative to the previous keyframe.
            progress: called with the number of keyframes processed so far.
        """
        ...

    def left_image(self, row: int) -> Image | None:
        """Returns the left image (H, W, 3) of the keyframe at frame index `row`, with square pixels; None without."""
        ...
