"""Flight of a mission frame by frame: sequence of the planned frames and times of the global alignments."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np

from twin.controllers.camera_surface import CameraSurface
from twin.controllers.curves import end_of
from twin.controllers.segments import Point, Reference, Segment
from twin.core.geometry import Array
from twin.core.records import Frame
from twin.core.settings import BRAKING_S
from twin.world.mission import FrameSequence, Mission
from twin.world.pace import FULL, Pace
from twin.world.world import FastForward, World

_RATE_RADPS = 1.5  #: rate at which the difference of the paths decays, about the bandwidth of the controller


class PathChange(NamedTuple):
    """Transition from the last path to a new one, without a step of position or velocity; arrays are (3,)."""

    left_m: Array  #: last minus new position at its start
    rate_mps: Array  #: last minus new velocity there
    start: int  #: frame at which it starts
    offset_m: Array = np.zeros(3)  #: offset of the new path from the planned one

    def at(self, first: int, n: int, rate_hz: float) -> tuple[Array, Array, Array]:
        """Returns what is left (n, 3) of the difference and its two derivatives at n frames from number `first` on."""
        w, t = _RATE_RADPS, ((first - self.start + np.arange(n)) / rate_hz)[:, None]
        slope, decay = self.rate_mps + w * self.left_m, np.exp(-w * t)
        left = (self.left_m + slope * t) * decay
        rate = slope * decay - w * left
        return left, rate, -w * (slope * decay + rate)

    def added_to(self, reference: Reference, first: int, rate_hz: float) -> Reference:
        """Returns the references of consecutive frames, of which the first has the number `first`."""
        left, rate, acceleration = self.at(first, len(reference.position), rate_hz)
        return reference._replace(
            position=reference.position + left + self.offset_m,
            velocity=reference.velocity + rate,
            acceleration=reference.acceleration + acceleration,
        )


_SAME_FACTOR = 0.01  # a factor of the pace that differs by less is set to the one that it approaches


def _no_further_path(last: Reference, end: Point) -> tuple[Segment, ...]:
    return ()  # a function, as a checkpoint cannot hold a lambda


class Flight:
    """Flight of a mission through its world: all tracks, with station keeping after each of them.

    `fast_forward` simulates frames between keyframes quickly (`World.fast_forward`); without, every frame is returned.
    A checkpoint leaves it out.
    """

    def __init__(self, mission: Mission, world: World, fast_forward: FastForward | None = None):
        self.mission, self.world = mission, world
        self.fast_forward, self._n_parts = fast_forward, 0
        self._mission = mission  # with the heights that the path has now
        self._change, self._is_changed = PathChange(np.zeros(3), np.zeros(3), 0), False
        self.pace_factor = self._factor = 1.0  #: of the pace along the path, above 0 to 1, which is approached smoothly
        #: whether the network is aligned before this frame, the first of the second half of the station keeping
        self.aligns = False
        self.n_skipped = 0  #: number of frames that `fast_forward` simulated in the last step
        #: path of one more track after the last reference and the end of the path, () for none
        self.further_path: Callable[[Reference, Point], tuple[Segment, ...]] = _no_further_path

    def __getstate__(self) -> dict[str, Any]:
        return vars(self) | {"fast_forward": None}

    @property
    def track(self) -> int:
        return self._sequence.track

    @property
    def reference(self) -> Reference:
        return self._step.reference

    @property
    def holding(self) -> bool:
        return self._step.holding

    def follow(self, surface: CameraSurface) -> None:
        """Lets the camera follow another surface after this frame, without a step of height or vertical velocity."""
        # a vehicle that keeps station keeps its height
        self._change_path(self._mission.above(surface), self._change.offset_m)

    def shift(self, offset_m: Array) -> None:
        """Shifts the path after this frame to an offset (3,) from the planned one, without a step, as `follow` does."""
        if not np.array_equal(offset_m, self._change.offset_m):
            self._change_path(self._mission, offset_m)

    def _change_path(self, mission: Mission, offset_m: Array) -> None:
        if self.holding:
            return
        sequence, path_time_s, last, now = self._sequence, self._path_time_s, self.reference, len(self.world) - 1
        new = mission.plan.reference(sequence.track, path_time_s)
        left_m, rate_mps, _ = (part[0] for part in self._change.at(now, 1, mission.plan.request.frame_rate_hz))
        left_m += self._change.offset_m - offset_m
        left_m[2] = last.position[2] - new.position[2] - offset_m[2]
        rate_mps[2] = last.velocity[2] - sequence.rate * new.velocity[2]
        self._mission, self._change = mission, PathChange(left_m, rate_mps, now, offset_m)
        self._is_changed = True
        self.world.end_sequence(self._k + 1)
        self._enter(self._mission.next_frames(sequence.track, path_time_s, FULL))
        self._k = -1

    def start(self) -> Frame:
        part = self._next_part()
        assert part is not None
        self._enter(*part)
        return self._observe()

    def step(self, command: Array, pace: Pace = FULL, keyframe: bool | None = None) -> Frame | None:
        """Moves the vehicle for one frame interval and returns the next frame; None after the last frame of the plan.

        The commands (n,) of the thrusters are in [-1, 1], or the velocity (3,) in the world [m/s] of a kinematic
        vehicle; `pace` has no effect during station keeping; the next frame is a keyframe, with both images, as planned
        or as given. Raises SurveyAborted if the command is not finite, or the physics diverged, and RuntimeError if an
        earlier call returned None.
        """
        if self._k == len(self._sequence):
            raise RuntimeError("all frames of the plan have been flown; reset starts another flight")
        self.world.act(command)
        self.n_skipped = 0
        sequence, k = self._sequence, self._k + 1
        pace = pace if sequence.holding else self._slowed(pace)
        if sequence.holding or (pace == FULL and sequence.rate == 1):
            self._k = k if self.fast_forward is None else self.fast_forward(sequence, k)
            self.n_skipped = self._k - k
        else:
            self.world.end_sequence(k)
            self._enter(self._mission.next_frames(sequence.track, self._path_time_s, pace))
        self.aligns = False
        while self._k == len(self._sequence):
            part = self._next_part()
            if part is None:
                return None
            self._enter(*part)
        return self._observe(keyframe)

    def _slowed(self, pace: Pace) -> Pace:
        if self._factor == self.pace_factor == 1:
            return pace
        change_per_s = (self.pace_factor - self._factor) / BRAKING_S
        self._factor += change_per_s / self.mission.plan.request.frame_rate_hz
        if abs(self.pace_factor - self._factor) < _SAME_FACTOR:
            self._factor, change_per_s = self.pace_factor, 0.0
        change_per_s = self._factor * pace.change_per_s + change_per_s * pace.rate
        return Pace(self._factor * pace.rate, change_per_s, pace.keyframe)

    def _next_part(self) -> tuple[FrameSequence, bool] | None:
        """Returns the next planned sequence, with `aligns` at its first frame; None after the last one."""
        # of a track: its path, and the two halves of the station keeping after it
        track, part = self._n_parts // 3 + 1, self._n_parts % 3
        if track > self._mission.plan.n_tracks:
            plan = self._mission.plan
            if not (path := self.further_path(self.reference, end_of(plan.paths[-1]))):
                return None
            self._mission = replace(self._mission, plan=replace(plan, paths=(*plan.paths, path)))
        self._n_parts += 1
        if part == 0:
            return self._mission.planned_frames(track), False
        return self._mission.station_keeping_frames(track, part - 1), part == 2

    def _enter(self, sequence: FrameSequence, aligns: bool = False) -> None:
        if self._is_changed:
            reference = self._change.added_to(
                sequence.reference, len(self.world), self.mission.plan.request.frame_rate_hz
            )
            sequence = replace(sequence, reference=reference)
        self._sequence, self._k, self.aligns = sequence, 0, aligns
        self.world.start_sequence(sequence)

    def _observe(self, keyframe: bool | None = None) -> Frame:
        planned = self._sequence[self._k]
        self._path_time_s = float(self._sequence.path_times_s[self._k])
        self._step = planned if keyframe is None else planned._replace(keyframe=keyframe)
        return self.world.observe(self._step)
