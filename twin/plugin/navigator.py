"""Estimator of another package in a survey (`estimate.plugin`) or a replay: map and metrics follow from its poses."""

from contextlib import AbstractContextManager
from dataclasses import replace

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Estimate, Frame, SurveyResult, Trajectory
from twin.core.settings import EstimatorSettings
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


class PluginNavigator(AbstractContextManager["PluginNavigator"]):
    """Estimators whose poses come from a plug-in; keyframes, stereo matching and maps are those of a `Navigator`.

    The F2F and the online trajectory are the online poses of the plug-in; the final trajectory is the result of its
    method `finish`. There are no links and no alignments. Keyframes are chosen by `settings` where `Frame.keyframe` is
    None; `vision` is closed by the caller. The time of the plug-in is that of the stage "f2f". Raises TwinError, which
    names `key`, if the plug-in cannot be loaded.
    """

    def __init__(
        self, name: str, setup: EstimatorSetup, settings: EstimatorSettings, vision: StereoVision, key: str = KEY
    ):
        settings = replace(settings, use_ga=False, use_f2m=False)
        self._plugin = GuardedPlugin(key, ESTIMATORS, name, METHODS, setup)
        self._navigator = Navigator(setup.rig, settings, setup.start, setup.noise, vision, stopwatch=vision.stopwatch)
        self.network, self.close = self._navigator.network, self._navigator.close
        self.build_map, self.build_tiles = self._navigator.build_map, self._navigator.build_tiles
        self.orthomosaic, self.with_tested_sigma = self._navigator.orthomosaic, self._navigator.with_tested_sigma
        self._images = vision
        self._pose, self._cov = setup.start.copy(), np.zeros((6, 6))
        self._node_covs: list[Array] = []
        self._twist = np.zeros(6)  # velocity at the last frame
        self._finishes = True

    def __exit__(self, *_: object) -> None:
        self.close()

    def update(self, frame: Frame, track: int = 1) -> Estimate:
        """Passes one frame to the plug-in and returns its online estimate.

        Without a pose of the plug-in, it has the last pose, the velocity zero, and a status other than "ok". Raises
        PluginFailed for an exception or an unusable value of the plug-in, ValueError for a frame that is not later than
        the last one or not of the size of the calibration, which the plug-in does not get.
        """
        log, rig, chosen_by = self._navigator.log, self._navigator.rig, self._navigator.filter
        interval_s = self._navigator.interval_s(frame.time_s)
        check_image_sizes(frame, (rig.width_px, rig.height_px))
        with self._images.stopwatch("f2f"):
            found = self._plugin.call("update", frame)
            cov = self._plugin.call("covariance")
        last, status = self._pose, "ok" if found is not None else _NO_POSE
        frozen = self._images.repeats.status(frame, self._twist, interval_s)
        if found is not None:
            self._pose = self._plugin.poses("update", found, (4, 4))
        self._cov = np.zeros((6, 6)) if cov is None else self._plugin.covariance("covariance", cov)
        log.n_lost += found is None
        chosen_by.f2f = chosen_by.world_from_camera = self._pose  # keyframes are chosen by these poses
        if frozen != "ok":
            log.repeats.setdefault(frozen, []).append(len(log))
        keyframe = self._stereo_keyframe(frame, track) if frozen == "ok" else None
        if keyframe is not None:
            self.network.add(keyframe)
            self._node_covs.append(self._cov)
        moved = geometry.inverse(last) @ self._pose if len(log) else np.eye(4)
        step = geometry.log(moved)
        log.append(frame.time_s, self._pose, self._pose, step, np.zeros(6))
        self._twist, sigma_m = step / interval_s, float(np.sqrt(np.trace(self._cov[3:, 3:])))
        status = status if frozen == "ok" else frozen
        return Estimate(frame.time_s, self._pose.copy(), self._pose.copy(), self._twist, sigma_m, status)

    def align_track(self, track: int) -> None:
        """Does nothing: the plug-in corrects its poses itself."""

    def abandon_alignment(self) -> None:
        """Disables the call of `finish` of the plug-in: the final trajectory is the online trajectory."""
        self._finishes = False

    def finish(self) -> SurveyResult:
        """Returns the result of the survey, with the trajectories and covariances that the plug-in gave.

        The final trajectory is the online one if `finish` of the plug-in returns None or is not called. Raises
        PluginFailed if it raised an exception or returned an unusable value.
        """
        result = self._navigator.finish()
        n = len(result.online)
        final = self._plugin.call("finish") if self._finishes and n else None
        if final is not None:
            final = self._plugin.poses("finish", final, (n, 4, 4))
            result = replace(result, final=Trajectory(result.online.times_s, final))
        covs = np.array(self._node_covs[: len(result.keyframe_rows)]).reshape(-1, 6, 6)
        return replace(result, node_cov=covs)

    def _stereo_keyframe(self, frame: Frame, track: int) -> Keyframe | None:
        if not self._navigator.is_keyframe(frame, "ok"):
            return None
        self._images.track_frame(frame)
        row, number = len(self._navigator.log), len(self.network.keyframes)
        points = self._images.observe_stereo(frame, row)
        if points is None:
            return None
        depth_m = float(np.median(points.xyz[:, 2]))
        return Keyframe(number, row, track, self._pose, points, frame.readings, depth_m, frame.exposure)


#: Estimators of a survey: those of `twin.estimate`, or those of a plug-in.
Estimators = Navigator | PluginNavigator


def navigator_of(
    name: str | None, setup: EstimatorSetup, settings: EstimatorSettings, vision: StereoVision, key: str = KEY
) -> Estimators:
    """Returns the estimators of `twin.estimate`, or those of a plug-in if one is named."""
    if name is not None:
        return PluginNavigator(name, setup, settings, vision, key)
    return Navigator(setup.rig, settings, setup.start, setup.noise, vision, stopwatch=vision.stopwatch)
