"""Actions of a mission in poor visibility: the vehicle slows down or stops where few or no motions are measured."""

from collections import deque
from collections.abc import Callable
from typing import Literal

from twin.core.quality import ActionTimes
from twin.core.records import NO_STEREO, Estimate
from twin.core.settings import BLIND_S, BRAKING_S
from twin.world.mission import Mission
from twin.world.pace import FULL, Pace

Action = Literal["fly", "slow", "hold"]

#: Rate of the path time in each action. After `hold`, the vehicle first flies at the rate of `slow`.
RATES: dict[Action, float] = {"fly": 1.0, "slow": 0.5, "hold": 0.0}
#: The vehicle slows down if more than the fraction MAX_LOST of the frames of the last WINDOW_S seconds was lost, and
#: returns to the planned speed after RECOVERED_S seconds of measured frames at which the fraction was not exceeded.
MAX_LOST, WINDOW_S, RECOVERED_S = 0.2, 1.0, 3.0
MAX_FAILED = 2
_SAME_RATE = 0.01  # a rate that differs by less is set to the rate of the action
_STOPPED = 0.1  # below this rate, keyframes are added, because the plan has none at the same place


class MissionActions:
    """Chooses the pace along the path from the status of the estimates, frame by frame; `log` gets each new action.

    The vehicle stops (`hold`) if no motion was measured for more than `BLIND_S` seconds, or `MAX_FAILED` keyframes in
    succession have no stereo: it would leave the last points that it can track. While blind, the speed that the
    estimators predict decays with the time constant with which the vehicle brakes (`BRAKING_S`), so prediction and
    reference agree. The vehicle slows down if many frames of the last second were lost; this is decided at measured
    frames only, because a predicted motion has the speed of the last measured one. A vehicle that cannot stop (it flies
    arcs) goes on along the path by dead reckoning. `n_frames` does not count frames of `add_measured_frames`.
    """

    def __init__(self, mission: Mission, log: Callable[..., None] | None = None):
        self._log = log
        self._can_stop = not mission.plan.flies_arcs
        self.rate_hz, self._n_per_keyframe = mission.plan.request.frame_rate_hz, mission.plan.n_frames_per_keyframe
        self.action: Action = "fly"
        self.n_frames: dict[Action, int] = dict.fromkeys(RATES, 0)
        self._rate, self._n_blind, self._n_recovered, self._n_stopped, self._n_failed = 1.0, 0, 0, 0, 0
        n_window = max(1, round(WINDOW_S * self.rate_hz))
        self._lost: deque[bool] = deque([False] * n_window, n_window)

    def __call__(self, estimate: Estimate, is_keyframe: bool = False) -> Pace:
        """Returns the pace to the next frame; `is_keyframe`: whether the frame of the estimate was to become one."""
        lost = estimate.status != "ok"
        if is_keyframe:
            self._n_failed = self._n_failed + 1 if estimate.status == NO_STEREO else 0
        self._n_blind = self._n_blind + 1 if lost else 0
        self._lost.append(lost)
        action = self._next_action(lost)
        if action != self.action and self._log is not None:
            self._log("action", time_s=estimate.time_s, action=action, status=estimate.status)
        self.action = action
        self.n_frames[self.action] += 1
        if self.action == "fly" and self._rate == 1:
            return FULL
        target = self._rate if lost and self.action != "hold" else RATES[self.action]
        return self._pace_towards(target)

    def add_measured_frames(self, n: int) -> None:
        """Registers n consecutive frames with measured motion, which the compiled loop does not report one by one."""
        if n:
            self._n_blind, self._n_recovered = 0, self._n_recovered + n
            self._lost.extend([False] * min(n, len(self._lost)))

    @property
    def times(self) -> ActionTimes:
        return ActionTimes(self.n_frames["slow"] / self.rate_hz, self.n_frames["hold"] / self.rate_hz)

    def _next_action(self, lost: bool) -> Action:
        if not self._can_stop:
            return "fly"
        if self._n_blind > BLIND_S * self.rate_hz or self._n_failed >= MAX_FAILED:
            return "hold"
        if lost:
            return self.action
        if sum(self._lost) > MAX_LOST * len(self._lost):
            self._n_recovered = 0
            return "slow"
        self._n_recovered += 1
        return "slow" if self.action != "fly" and self._n_recovered < RECOVERED_S * self.rate_hz else "fly"

    def _pace_towards(self, target: float) -> Pace:
        change_per_s = (target - self._rate) / BRAKING_S
        self._rate += change_per_s / self.rate_hz
        if abs(target - self._rate) < _SAME_RATE:
            self._rate = target
        self._n_stopped = self._n_stopped + 1 if self._rate < _STOPPED else 0
        keyframe = self._n_stopped > 0 and self._n_stopped % self._n_per_keyframe == 0
        return Pace(self._rate, change_per_s if self._rate != target else 0.0, keyframe)
