"""Monitoring of a running survey: progress, log, live view, and abort if vision is lost or the position uncertain."""

import time
from collections import deque
from collections.abc import Callable
from typing import Any, NamedTuple

from twin.core.records import REPEATS, Estimate, Frame
from twin.errors import SurveyAborted
from twin.report.run_writer import RunFolder
from twin.session.mission_actions import MissionActions
from twin.world.mission import Mission

#: Vision is lost, and the survey is aborted, if fewer than the fraction _MIN_MEASURED of the frames of the last
#: _MAX_BLIND_S seconds were measured, _WITH_DVL_S if a DVL measures the motion meanwhile; the vehicle has then been
#: stopped for a while. Where no floor is visible, a few percent of the frames match by chance.
_MAX_BLIND_S, _WITH_DVL_S, _MIN_MEASURED = 6.0, 20.0, 0.1
_MAX_HELD_S = 60.0  # the survey is aborted if the vehicle is stopped for longer in total
_MAX_SIGMA = 0.5  # largest ratio of position sigma to shorter side of the footprint; the survey is aborted beyond it


class SurveyProgress(NamedTuple):
    """Progress of a survey; simulated time and sigma are 0 after the flight."""

    simulated_s: float
    wall_s: float
    share: float  #: completed fraction of `stage`, 0 to 1
    sigma_m: float  #: standard deviation of the online position, root of the sum of the three variances
    stage: str  #: current stage, "survey", "map", "orthomosaic" or "report"


class SurveyMonitor:
    """Reports the progress of a survey at the frames that it is given; aborts a survey that cannot continue.

    It cannot continue if vision is lost, the vehicle has been stopped for too long, or the position is too uncertain.
    Frames between keyframes that the compiled loop of a surrogate survey simulates are not given to it.
    """

    def __init__(self, mission: Mission, folder: RunFolder, progress: Callable[[SurveyProgress], None]):
        self.n_frames, self.rate_hz = mission.n_frames, mission.rig.frame_rate_hz
        self.water = mission.scenario.water.label
        self.folder, self.progress, self.start_s = folder, progress, time.perf_counter()
        self.live: Any = None  # a LiveViewer
        self.status = "ok"
        longest_s = _WITH_DVL_S if "dvl" in mission.scenario.navigation.aiding else _MAX_BLIND_S
        self._measured = deque([True] * round(longest_s * self.rate_hz))
        self.actions = MissionActions(mission, folder.log)
        self.max_sigma_m = _MAX_SIGMA * min(mission.plan.request.footprint_m)

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"live": None, "start_s": self.wall_s}

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restores the monitor; the time between the checkpoint and now does not count."""
        vars(self).update(state)
        self.start_s = time.perf_counter() - state["start_s"]

    def __call__(self, estimate: Estimate, frame: Frame) -> None:
        """Reports progress and vision status of a frame; raises SurveyAborted if the survey cannot continue."""
        self._measured.append(estimate.status == "ok")
        self._measured.popleft()
        if estimate.status != self.status:
            self.folder.log("vision", time_s=estimate.time_s, status=estimate.status)
            self.status = estimate.status
        if self.live is not None:
            self.live.log_frame(frame, estimate)
        share = min((frame.index + 1) / self.n_frames, 1.0)  # a slowed survey has more frames than planned
        self.progress(SurveyProgress(estimate.time_s, self.wall_s, share, estimate.sigma_m, "survey"))
        if sum(self._measured) < _MIN_MEASURED * len(self._measured):
            where = "" if estimate.status in REPEATS else f" in water {self.water}"
            raise SurveyAborted(f"vision lost at {estimate.time_s:.1f} s{where}: {estimate.status}")
        if self.actions.times.held_s > _MAX_HELD_S:
            raise SurveyAborted(f"the vehicle was stopped for {_MAX_HELD_S:g} s in total because vision was lost")
        if estimate.sigma_m > self.max_sigma_m:
            raise SurveyAborted(
                f"the standard deviation of the position reached {estimate.sigma_m:.2f} m at {estimate.time_s:.1f} s"
                f" (at most {self.max_sigma_m:.2f} m allowed)"
            )

    def report_stage(self, stage: str, share: float) -> None:
        """Reports the completed fraction of a stage that follows the flight: "map", "orthomosaic" or "report"."""
        self.progress(SurveyProgress(0.0, self.wall_s, share, 0.0, stage))

    @property
    def wall_s(self) -> float:
        return time.perf_counter() - self.start_s
