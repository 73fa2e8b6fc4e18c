"""Simulated world that a program advances frame by frame (`twin.World`)."""

from collections.abc import Callable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import NamedTuple

import numpy as np

from twin.controllers.segments import Reference
from twin.core.geometry import Array
from twin.core.records import Estimate, Frame, Image, StereoRig, Truth
from twin.core.threads import one_blas_thread
from twin.core.timing import Stopwatch
from twin.errors import TwinError
from twin.scenario.model import Scenario
from twin.session.assembly import Estimators, make_navigator, open_world
from twin.session.mission_actions import MissionActions
from twin.session.path_adaptation import PathAdaptation
from twin.world.mission import prepare
from twin.world.mission_flight import Flight
from twin.world.pace import FULL, Pace
from twin.world.pilot import make_pilot, without_feedback
from twin.world.world import World


class StereoPair(NamedTuple):
    """Left and right image (H, W, 3) uint8 RGB of one exposure."""

    left: Image
    right: Image


class SteppedWorld(AbstractContextManager["SteppedWorld"]):
    """Simulated world of a scenario, advanced frame by frame. Use as a context manager, or call `close`.

    `reset` starts the survey and returns its first frame; `step` moves the vehicle by one frame interval and returns
    the next frame of the plan. A frame holds images and sensor readings, no truth. The same seed and the same commands
    give the same frames, bit for bit. Use one object in one thread. Before `reset`, all methods and properties that
    need a flight raise RuntimeError. Raises ScenarioError if the survey cannot be flown.
    """

    def __init__(self, scenario: Scenario):
        self.mission = prepare(scenario)
        self._open = ExitStack()
        self._flight: Flight | None = None
        self._estimators: Estimators | None = None
        self._stopwatch = Stopwatch()

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Ends the flight: closes its estimators; `reset` can start another flight."""
        self._flight = self._estimators = None
        self._open.close()

    def reset(self, seed: int | None = None) -> Frame:
        """Starts the survey anew and returns its first frame; the vehicle is at rest at the start of the plan.

        Args:
            seed: seed of all random numbers, as the key `seed` of a scenario; None: the seed of the last flight, or
                that of the scenario before the first flight.

        Raises:
            ScenarioError: the survey cannot be flown with this seed, for example over the floor that it generates.
            TwinError: the world cannot be created (`open_world`).
        """
        if not (seed is None or (seed == int(seed) and 0 <= seed < 2**32)):
            raise TwinError("seed", f"{seed!r}", "a whole number from 0 to 4294967295")
        self.close()
        self._open.enter_context(one_blas_thread())
        scenario = self.mission.scenario
        if seed is not None and seed != scenario.seed:
            self.mission = prepare(scenario.model_copy(update={"seed": seed}))
        self._stopwatch = Stopwatch()
        world = self._open.enter_context(open_world(self.mission, self._stopwatch))
        self._flight = Flight(self.mission, world)
        return self._flight.start()

    def step(self, command: Array, pace: Pace = FULL, keyframe: bool | None = None) -> Frame | None:
        """Moves the vehicle for one frame interval under a constant command and returns the next frame.

        Args:
            command: (n,) commands in [-1, 1] of `vehicle.thrusters`, then of the movable `vehicle.fins`; larger values
                are limited. For vehicle.dynamics = "kinematic" the velocity (3,) in the world [m/s].
            pace: pace along the planned path from this frame to the next, from `actions`.
            keyframe: whether the next frame is a keyframe, which has both images; None: as planned.

        Returns:
            The next frame; None if the last frame of the plan has been flown.

        Raises:
            ValueError: the command has another shape.
            RuntimeError: `reset` was not called, or was not called again after `step` returned None.
            SurveyAborted: the physics diverged, for example because a command is not finite.
        """
        values, vehicle = np.array(command, dtype=np.float64), self.mission.scenario.vehicle
        n = vehicle.n_commands if vehicle.dynamics == "rigid" else 3
        if values.shape != (n,):
            raise ValueError(f"the command has the shape {values.shape} (expected: ({n},))")
        return self.flight.step(values, pace, keyframe)

    def capture(self) -> StereoPair:
        """Returns a stereo pair at the current pose, without effect on later frames; raises TwinError if surrogate."""
        return StereoPair(*self.world.extra_pair())

    def truth(self) -> Truth:
        """Returns the ground truth of the survey so far; it must not reach an estimator."""
        return self.world.truth()

    def estimator(self, folder: Path | None = None) -> Estimators:
        """Returns the estimators of the scenario, which get the believed calibration and no truth; `close` closes them.

        Images of keyframes go to `folder`; None: to a temporary folder that `close` removes. Raises TwinError if the
        plug-in that the scenario names cannot be loaded.
        """
        if folder is None:
            folder = Path(self._open.enter_context(TemporaryDirectory(prefix="twin-")))
        opened = self._open.enter_context(make_navigator(self.mission, self.world, folder, self._stopwatch))
        self._estimators = opened
        return opened

    def pilot(self) -> Callable[[Estimate, Frame], Array]:
        """Returns the controller of the scenario: a function from the estimate of a frame and this frame to a command.

        It steers to the reference of the current frame, and adapts the path to what `estimator` has measured, as
        `control.height`, `plan.fill_gaps` and a plug-in ask. Raises TwinError if the plug-in that the scenario names
        cannot be loaded.
        """
        steer, flight = make_pilot(self.mission, self.world.thruster_monitor), self.flight
        adapt = PathAdaptation(flight, steer)

        def command(estimate: Estimate, frame: Frame) -> Array:
            found = steer(without_feedback(estimate, flight.reference, frame.readings), flight.reference)
            if self._estimators is not None:
                adapt(frame, estimate, self._estimators)
            return found

        return command

    def actions(self) -> MissionActions:
        """Returns the actions in poor visibility: a function from an estimate to the pace towards the next frame."""
        return MissionActions(self.mission)

    @property
    def rig(self) -> StereoRig:
        return self.mission.rig

    @property
    def world(self) -> World:
        return self.flight.world

    @property
    def flight(self) -> Flight:
        """Returns the flight in progress. Raises RuntimeError before `reset`."""
        if self._flight is None:
            raise RuntimeError("call reset first")
        return self._flight

    @property
    def reference(self) -> Reference:
        """Returns the planned position, velocity, yaw and acceleration of the left camera at the current frame."""
        return self.flight.reference

    @property
    def track(self) -> int:
        """Returns the number of the track of the current frame, from 1."""
        return self.flight.track

    @property
    def aligns(self) -> bool:
        """Returns whether the network is aligned before the current frame is estimated (`Flight.aligns`)."""
        return self.flight.aligns

    @property
    def true_pose(self) -> Array:
        """Returns the true world_from_camera (4, 4) of the left camera at the current frame; not for estimators."""
        return self.world.world_from_camera
