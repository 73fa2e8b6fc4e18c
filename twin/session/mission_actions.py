"""Actions of a survey on its own estimates: the vehicle slows down if tracking is poor, and stops if vision is lost."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Literal

from twin.core.braking import BLIND_S, BRAKING_S
from twin.core.quality import ActionTimes
from twin.core.records import Estimate
from twin.world.mission import Mission
from twin.world.pace import FULL, Pace

Action = Literal["fly", "slow", "hold"]

#: Path time per time of each action. After `hold`, the vehicle first flies at the rate of `slow`.
RATES: dict[Action, float] = {"fly": 1.0, "slow": 0.5, "hold": 0.0}
#: The vehicle slows down if more than this fraction of the frames of the last WINDOW_S seconds was lost, and flies at
#: full speed after SOUND_S seconds without it.
MAX_LOST, WINDOW_S, SOUND_S = 0.2, 1.0, 3.0
_SAME_RATE = 0.01  # a rate that differs by less is set to the rate of the action
_STOPPED = 0.1  # below this rate, keyframes are added, because the plan has none at the same place


class MissionActions:
    """Chooses the pace along the path from the status of the estimates, frame by frame.

    The vehicle stops (`hold`) if no motion was measured for `BLIND_S`, where the prediction of the estimators starts to
    brake with the same time constant, so that prediction and reference agree. It slows down if many frames of the last
    second were lost; this is decided at measured frames only, because a predicted motion has the speed of the last
    measured one.

    Args:
        mission: the survey to fly.
        log: called with each new action and the estimate that caused it.

    Attributes:
        action: the current action.
        n_frames: number of frames flown in each action.
    """

    def __init__(self, mission: Mission, log: Callable[[Action, Estimate], None] | None = None):
        self._log = log
        self.rate_hz, self._n_per_keyframe = mission.plan.frame_rate_hz, mission.plan.n_frames_per_keyframe
        self.action: Action = "fly"
        self.n_frames: dict[Action, int] = dict.fromkeys(RATES, 0)
        self._rate, self._n_blind, self._n_sound, self._n_stopped = 1.0, 0, 0, 0
        n_window = max(1, round(WINDOW_S * self.rate_hz))
        self._lost: deque[bool] = deque([False] * n_window, n_window)

    def __call__(self, estimate: Estimate) -> Pace:
        """Returns the pace of the next frame, after the estimate of the last one."""
        lost = estimate.status != "ok"
        self._n_blind = self._n_blind + 1 if lost else 0
        self._lost.append(lost)
        action = self._next_action(lost)
        if action != self.action and self._log is not None:
            self._log(action, estimate)
        self.action = action
        self.n_frames[self.action] += 1
        if self.action == "fly" and self._rate == 1:
            return FULL
        target = self._rate if lost and self.action != "hold" else RATES[self.action]
        return self._pace_towards(target)

    def add_sound_frames(self, n: int) -> None:
        """Counts n frames whose motion was measured and that were flown without asking for the pace."""
        if n:
            self._n_blind, self._n_sound = 0, self._n_sound + n
            self._lost.extend([False] * min(n, len(self._lost)))

    @property
    def times(self) -> ActionTimes:
        """Returns how long the vehicle flew slowly and was stopped."""
        return ActionTimes(self.n_frames["slow"] / self.rate_hz, self.n_frames["hold"] / self.rate_hz)

    def _next_action(self, lost: bool) -> Action:
        """Returns the action after a frame whose motion was lost or measured."""
        if self._n_blind > BLIND_S * self.rate_hz:
            return "hold"
        if lost:
            return self.action
        if sum(self._lost) > MAX_LOST * len(self._lost):
            self._n_sound = 0
            return "slow"
        self._n_sound += 1
        return self.action if self.action != "fly" and self._n_sound < SOUND_S * self.rate_hz else "fly"

    def _pace_towards(self, target: float) -> Pace:
        """Moves the rate towards a target with a first-order lag, and returns the pace."""
        change_per_s = (target - self._rate) / BRAKING_S
        self._rate += change_per_s / self.rate_hz
        if abs(target - self._rate) < _SAME_RATE:
            self._rate = target
        self._n_stopped = self._n_stopped + 1 if self._rate < _STOPPED else 0
        keyframe = self._n_stopped > 0 and self._n_stopped % self._n_per_keyframe == 0
        return Pace(self._rate, change_per_s if self._rate != target else 0.0, keyframe)
