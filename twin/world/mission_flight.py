"""Flight of a mission frame by frame: sequence of the planned frames and times of the global alignments."""

from __future__ import annotations

from collections.abc import Iterator

from twin.controllers.segments import Reference
from twin.core.geometry import Array
from twin.core.records import Frame
from twin.world.mission import FrameSequence, Mission
from twin.world.pace import FULL, Pace
from twin.world.world import FastForward, World


class Flight:
    """Flight of a mission through its world: all tracks, with station keeping after each of them.

    Args:
        fast_forward: simulates frames between keyframes quickly (`World.fast_forward`); None: every frame is returned.

    Attributes:
        aligns: whether the network is aligned before the current frame is estimated: it is the first one of the second
            half of the station keeping after a track.
        n_skipped: number of frames that `fast_forward` simulated in the last step.
    """

    def __init__(self, mission: Mission, world: World, fast_forward: FastForward | None = None):
        self.mission, self.world = mission, world
        self._fast_forward, self._parts = fast_forward, self._planned_parts()
        self.aligns, self.n_skipped = False, 0

    @property
    def track(self) -> int:
        return self._sequence.track

    @property
    def reference(self) -> Reference:
        return self._step.reference

    @property
    def holding(self) -> bool:
        return self._step.holding

    def start(self) -> Frame:
        self._enter(*next(self._parts))
        return self._observe()

    def step(self, command: Array, pace: Pace = FULL, keyframe: bool | None = None) -> Frame | None:
        """Moves the vehicle for one frame interval and returns the next frame; None after the last frame of the plan.

        Args:
            command: (n,) thruster commands in [-1, 1], or velocity (3,) in the world [m/s] of a kinematic vehicle.
            pace: pace along the planned path from this frame to the next; no effect during station keeping.
            keyframe: whether the next frame is a keyframe, with both images; None: as planned.

        Raises:
            RuntimeError: an earlier call returned None.
            SurveyAborted: the command is not finite, or the physics diverged.
        """
        if self._k == len(self._sequence):
            raise RuntimeError("all frames of the plan have been flown; reset starts another flight")
        self.world.act(command)
        self.n_skipped = 0
        sequence, k = self._sequence, self._k + 1
        if sequence.holding or (pace == FULL and sequence.rate == 1):
            self._k = k if self._fast_forward is None else self._fast_forward(sequence, k)
            self.n_skipped = self._k - k
        else:
            self.world.end_sequence(k)
            self._enter(self.mission.next_frames(sequence.track, sequence.path_times_s[k - 1], pace))
        self.aligns = False
        while self._k == len(self._sequence):
            part = next(self._parts, None)
            if part is None:
                return None
            self._enter(*part)
        return self._observe(keyframe)

    def _planned_parts(self) -> Iterator[tuple[FrameSequence, bool]]:
        """Yields the planned sequences, each with the value of `aligns` at its first frame."""
        for track in self.mission.tracks:
            yield self.mission.planned_frames(track), False
            yield self.mission.station_keeping_frames(track), False
            yield self.mission.station_keeping_frames(track), True

    def _enter(self, sequence: FrameSequence, aligns: bool = False) -> None:
        self._sequence, self._k, self.aligns = sequence, 0, aligns
        self.world.start_sequence(sequence)

    def _observe(self, keyframe: bool | None = None) -> Frame:
        planned = self._sequence[self._k]
        self._step = planned if keyframe is None else planned._replace(keyframe=keyframe)
        return self.world.observe(self._step)
