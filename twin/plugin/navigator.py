"""Estimator of another package in a survey (`estimate.plugin`) or a replay: map and metrics follow from its poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Estimate, Frame, SurveyResult, Trajectory
from twin.core.settings import EstimatorSettings
from twin.core.timing import StageTimer
from twin.estimate.pipeline import Navigator
from twin.estimate.stereo_vision import StereoVision, check_image_sizes
from twin.estimate.vision.stereo import Keyframe
from twin.plugin.guard import GuardedPlugin
from twin.plugin.loading import ESTIMATORS
from twin.plugin.protocols import EstimatorSetup

METHODS = ("update", "covariance", "finish")
KEY = "estimate.plugin"  # key of a scenario that names the plug-in
NOTE = (
    "The trajectories are those of the plug-in {}: its online poses (shown as F2F and as online) and the poses that it "
    "returned at the end (final). There are no links and no alignments."
)
_NO_POSE = "the plug-in measured no pose"


class PluginNavigator(Navigator):
    """Navigator whose poses come from a plug-in; stereo matching and the map are those of `Navigator`.

    The F2F and the online trajectory are the online poses of the plug-in; the final trajectory is the result of its
    method `finish`. There are no links and no alignments.

    Args:
        name: "module:Class", or the name of an entry point.
        setup: believed calibration, start and sensor noise, which the plug-in gets.
        settings: settings of the stereo matching, and of the choice of keyframes where `Frame.keyframe` is None.
        vision: stereo matching and images of the keyframes, for the map; closed by the caller.
        stopwatch: timer of the stages; the time of the plug-in is that of the stage "f2f".
        key: key or option that names the plug-in, for messages.

    Raises:
        TwinError: the plug-in cannot be loaded.
    """

    def __init__(
        self,
        name: str,
        setup: EstimatorSetup,
        settings: EstimatorSettings,
        vision: StereoVision,
        stopwatch: StageTimer,
        key: str = KEY,
    ):
        settings = replace(settings, use_ga=False, use_f2m=False)
        super().__init__(setup.rig, settings, setup.start, setup.noise, vision, stopwatch=stopwatch)
        self._plugin = GuardedPlugin(key, ESTIMATORS, name, METHODS, setup)
        self._images, self._pose, self._cov = vision, setup.start.copy(), np.zeros((6, 6))
        self._node_covs: list[Array] = []
        self._twist = np.zeros(6)  # velocity at the last frame
        self._finishes = True

    def update(self, frame: Frame, track: int = 1) -> Estimate:
        """Passes one frame to the plug-in and returns its online estimate.

        If the plug-in returns no pose, the estimate has the last pose, the velocity zero, and a status other than "ok".

        Raises:
            PluginFailed: the plug-in raised an exception or returned an unusable value.
            ValueError: the frame is not later than the last one, or an image is not of the size that the calibration
                states; the plug-in does not get the frame.
            OSError: images could not be written.
        """
        interval_s = self._interval_s(frame.time_s)
        check_image_sizes(frame, (self.rig.width_px, self.rig.height_px))
        with self.stopwatch("f2f"):
            found = self._plugin.call("update", frame)
            cov = self._plugin.call("covariance")
        last, status = self._pose, "ok" if found is not None else _NO_POSE
        frozen = self._images.repeats.status(frame, self._twist, interval_s)
        if found is not None:
            self._pose = self._plugin.poses("update", found, (4, 4))
        self._cov = np.zeros((6, 6)) if cov is None else self._plugin.covariance("covariance", cov)
        self.log.n_lost += found is None
        self.filter.f2f = self.filter.world_from_camera = self._pose  # by which keyframes are chosen
        if frozen != "ok":
            self.log.repeats.setdefault(frozen, []).append(len(self.log))
        keyframe = self._stereo_keyframe(frame, track) if frozen == "ok" else None
        if keyframe is not None:
            self.network.add(keyframe)
            self._node_covs.append(self._cov)
        moved = geometry.inverse(last) @ self._pose if len(self.log) else np.eye(4)
        step = geometry.log(moved)
        self.log.append(frame.time_s, self._pose, self._pose, step, np.zeros(6))
        self._twist, sigma_m = step / interval_s, float(np.sqrt(np.trace(self._cov[3:, 3:])))
        status = status if frozen == "ok" else frozen
        return Estimate(frame.time_s, self._pose.copy(), self._pose.copy(), self._twist, sigma_m, status)

    def align_track(self, track: int) -> None:
        """Does nothing: the plug-in corrects its poses itself."""

    def abandon_alignment(self) -> None:
        """Disables the call of `finish` of the plug-in: the final trajectory is the online trajectory."""
        super().abandon_alignment()
        self._finishes = False

    def finish(self) -> SurveyResult:
        """Returns the result of the survey, with the trajectories and covariances that the plug-in gave.

        The final trajectory is the online one if `finish` of the plug-in returns None or is not called.

        Raises:
            PluginFailed: `finish` of the plug-in raised an exception or returned an unusable value.
        """
        result = super().finish()
        n = len(result.online)
        final = self._plugin.call("finish") if self._finishes and n else None
        if final is not None:
            final = self._plugin.poses("finish", final, (n, 4, 4))
            result = replace(result, final=Trajectory(result.online.times_s, final))
        covs = np.array(self._node_covs[: len(result.keyframe_rows)]).reshape(-1, 6, 6)
        return replace(result, node_cov=covs)

    def _stereo_keyframe(self, frame: Frame, track: int) -> Keyframe | None:
        """Returns the keyframe of a frame; None if the frame is not one, or if it has too few matched points."""
        if not self._is_keyframe(frame, "ok"):
            return None
        self._images.track_frame(frame)
        row, number = len(self.log), len(self.network.keyframes)
        points = self._images.observe_stereo(frame, row)
        if points is None:
            return None
        depth_m = float(np.median(points.xyz[:, 2]))
        return Keyframe(number, row, track, self._pose, points, frame.readings, depth_m, frame.exposure)
