"""Gymnasium environments over `twin.World`: "twin.gym:SeabedTwin-v0" and "twin.gym:SeabedTwinState-v0", without images.

Importing this module registers the environment. It needs the extra `gym` of the package.
"""

from collections.abc import Callable, Sequence
from typing import Any, Literal, SupportsFloat

import numpy as np
from numpy.typing import NDArray

from twin.controllers.segments import Reference
from twin.core import geometry
from twin.core.records import Array, Estimate, Frame
from twin.errors import SurveyAborted, TwinError
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario
from twin.session.stepped_world import SteppedWorld
from twin.world.pilot import make_pilot, without_feedback

try:
    import gymnasium
    from gymnasium import spaces
except ImportError as error:
    raise ImportError("twin.gym needs the package gymnasium: pip install 'seabed-twin[gym]'") from error

ENVIRONMENT, STATE_ENVIRONMENT = "SeabedTwin-v0", "SeabedTwinState-v0"
#: Turn rate for a yaw action of 1 [rad/s]; speed for a velocity action of 1, divided by the planned speed.
YAW_RATE_RADPS, SPEED_RATIO = 0.5, 1.5

Observation = dict[str, Any]


class _SurveyEnv(gymnasium.Env[Observation, NDArray[np.float32]]):
    """What both environments share: the world, the action and the target of the controller."""

    def __init__(self, given: Scenario, action: str):
        if action not in ("velocity", "thrust") or (action == "thrust" and given.vehicle.dynamics != "rigid"):
            raise TwinError("action", f"{action!r}: not for this vehicle", '"velocity", or "thrust" of a rigid vehicle')
        if action == "velocity" and given.vehicle.is_steered_by_fins:
            raise TwinError("action", f"{action!r}: not for a vehicle that is steered by fins", '"thrust"')
        self.world, self._velocity_action = SteppedWorld(given), action == "velocity"
        self._most_mps = SPEED_RATIO * given.plan.speed_mps
        n = 4 if self._velocity_action else given.vehicle.n_commands
        self.action_space = spaces.Box(-1.0, 1.0, (n,), np.float32)

    def close(self) -> None:
        """Ends the episode: closes the estimators."""
        self.world.close()

    @property
    def distance_m(self) -> float:
        """Returns the distance of the left camera from its planned position [m]."""
        return float(np.linalg.norm(self.world.true_pose[:3, 3] - self.world.reference.position))

    def _start(self) -> None:
        self._frame = self.world.reset(int(self.np_random.integers(2**31)))
        self._steer, start = make_pilot(self.world.mission, self.world.world.thruster_monitor), self.world.reference
        self._target = Reference(start.position.copy(), np.zeros(3), float(start.yaw), np.zeros(3))

    def _command(self, values: Array) -> Array:
        """Returns the command of the vehicle for one frame; a velocity also moves the target of the controller."""
        if not self._velocity_action:
            return values
        self._target = moved(self._target, values, self._most_mps, 1 / self.world.rig.frame_rate_hz)
        return self._steer(self._seen_by_controller(), self._target)

    def _seen_by_controller(self) -> Estimate:
        raise NotImplementedError

    def _fly(self, action: NDArray[np.float32], n_frames: int, ends_at_keyframe: bool) -> tuple[str, bool]:
        """Applies an action for some frames; returns why the episode ends, or "", and whether the plan is flown."""
        values, is_over = np.clip(np.asarray(action, np.float64), -1.0, 1.0), False
        try:
            for k in range(n_frames):
                keyframe = k + 1 == n_frames if ends_at_keyframe else None
                frame = self.world.step(self._command(values), keyframe=keyframe)
                if is_over := frame is None:
                    break
                self._frame = frame
                self._perceive()
        except SurveyAborted as error:
            return str(error), False
        x, y = self.world.true_pose[:2, 3]
        has_left = np.isnan(self.world.mission.terrain.height_at(x, y))
        return "the camera left the terrain" if has_left else "", is_over

    def _perceive(self) -> None:
        """Passes a frame to what the environment has of estimators."""


class SeabedTwinEnv(_SurveyEnv):
    """Survey of a scenario as a reinforcement-learning environment.

    A step lasts from one keyframe to the next: `frames_per_step` frames, the last of which has both images. The
    estimators of the scenario run in the loop and give the believed pose. The truth is only in `info` and in the
    reward. An episode is truncated after the last frame of the plan. It is terminated if the survey is aborted, for
    example because the hull touches the floor, or if the left camera is outside the terrain at the end of a step.

    Observation (dictionary):
        left, right: (H, W, 3) uint8 RGB, rectified stereo pair.
        readings: (7,) float64: height from pressure [m]; roll, pitch, yaw [rad]; velocity from the DVL in body axes
            [m/s]. Zero where `available` is 0.
        available: (3,) int8, whether there are readings of pressure, attitude and DVL.
        pose: (7,) float64, believed pose of the left camera in the world: x, y, z [m], quaternion x, y, z, w.
        reference: (4,) float64, planned x, y, z [m] of the left camera and yaw [rad] of the vehicle at this time.

    Action, each value in [-1, 1]:
        "velocity": (4,) forward, left and up velocity of the left camera, and yaw rate to the left. 1 is 1.5 times
            plan.speed_mps, or 0.5 rad/s. The controller of the scenario steers, by the believed pose, to the
            position and yaw that follow from integration of these velocities.
        "thrust": (n,) commands of the thrusters and movable fins of a rigid vehicle.

    Reward of a step:
        "coverage": part of the asked area that both cameras saw for the first time, in a keyframe [m2].
        "track": minus the distance of the true left camera from its planned position at the end of the step [m].

    Info: `time_s`; `truth`, with `world_from_camera` (4, 4), `distance_to_plan_m` (from the planned position) and
    `covered` (fraction of the asked area seen so far); `ended`, the reason for the termination, or "".

    Args:
        scenario: name or path of a scenario with imaging.fidelity = "rendered".
        overrides: strings "key=value" that replace values of the scenario.
        render_mode: None, or "rgb_array": `render` returns the stereo pair side by side.

    Raises:
        TwinError: the scenario cannot be flown or has no images, or the value of an argument is not allowed.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 3}

    def __init__(
        self, scenario: str = "quickstart", overrides: Sequence[str] = (),
        action: Literal["velocity", "thrust"] = "velocity", reward: Literal["coverage", "track"] = "coverage",
        render_mode: str | None = None, allow_plugins: bool = False,
    ):  # fmt: skip
        given = load_scenario(scenario, overrides, allow_plugins)
        if given.imaging.fidelity != "rendered":
            raise TwinError("imaging.fidelity", f"{given.imaging.fidelity!r} has no images", '"rendered"')
        if reward not in ("coverage", "track"):
            raise TwinError("reward", f"{reward!r}: no such reward", '"coverage" or "track"')
        super().__init__(given, action)
        self._reward, self.render_mode = reward, render_mode
        shape = (self.world.rig.height_px, self.world.rig.width_px, 3)
        images = {name: spaces.Box(0, 255, shape, np.uint8) for name in ("left", "right")}
        numbers = {
            name: spaces.Box(-np.inf, np.inf, (n,), np.float64)
            for name, n in (("readings", 7), ("pose", 7), ("reference", 4))
        }
        self.observation_space = spaces.Dict({**images, **numbers, "available": spaces.MultiBinary(3)})

    @property
    def frames_per_step(self) -> int:
        """Returns the number of frames of a step. It depends on the floor, and thus on the seed of the scenario."""
        return self.world.mission.plan.n_frames_per_keyframe

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode and returns its first observation and its info; `options` are not used.

        The seed of the scenario (floor, noise) is drawn from the random generator of the environment, which `seed`
        restarts. Raises ScenarioError if the survey cannot be flown with it, TwinError if the world cannot be created.
        """
        super().reset(seed=seed)
        self._start()
        self._navigator = self.world.estimator()
        self._estimate = self._navigator.update(self._frame, 1)
        grid = self.world.mission.grid
        self._asked = self.world.mission.asked(*np.meshgrid(*grid.centres()))
        self._covered_m2 = self._seen_m2()
        self._ended = ""
        return self._observation(), self._info()

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Applies an action up to the next keyframe; returns observation, reward, terminated, truncated and info."""
        ended, truncated = self._fly(action, self.frames_per_step, ends_at_keyframe=True)
        self._ended = self._ended or ended
        seen_m2 = self._seen_m2()
        gained_m2, self._covered_m2 = seen_m2 - self._covered_m2, seen_m2
        reward = gained_m2 if self._reward == "coverage" else -self.distance_m
        return self._observation(), reward, bool(self._ended), truncated, self._info()

    def _perceive(self) -> None:
        if self.world.aligns:
            self._navigator.align_track(self.world.track)
        self._estimate = self._navigator.update(self._frame, self.world.track)

    def render(self) -> NDArray[np.uint8] | None:
        """Returns the stereo pair side by side (H, 2 W, 3); None unless the render mode is "rgb_array"."""
        if self.render_mode != "rgb_array":
            return None
        return np.concatenate([self._frame.left, self._right()], axis=1)

    def _seen_by_controller(self) -> Estimate:
        return without_feedback(self._estimate, self._target, self._frame.readings)

    def _observation(self) -> Observation:
        reference, pose = self.world.reference, self._estimate.world_from_camera
        readings, available = _readings(self._frame)
        return {
            "left": self._frame.left,
            "right": self._right(),
            "readings": readings,
            "available": available,
            "pose": np.concatenate([pose[:3, 3], geometry.quaternion_xyzw(pose[:3, :3])]),
            "reference": np.append(reference.position, float(reference.yaw)),
        }

    def _right(self) -> NDArray[np.uint8]:
        """Returns the right image; at a frame without one, that of an extra exposure (`SteppedWorld.capture`)."""
        return self.world.capture().right if self._frame.right is None else self._frame.right

    def _info(self) -> dict[str, Any]:
        asked_m2 = float(self._asked.sum()) * self.world.mission.grid.cell_m**2
        truth = {
            "world_from_camera": self.world.true_pose,
            "distance_to_plan_m": self.distance_m,
            "covered": self._covered_m2 / asked_m2 if asked_m2 else 1.0,
        }
        return {"time_s": self._frame.time_s, "truth": truth, "ended": self._ended}

    def _seen_m2(self) -> float:
        return float((self.world.world.seen() & self._asked).sum()) * self.world.mission.grid.cell_m**2


class SeabedTwinStateEnv(_SurveyEnv):
    """Vehicle of a scenario by its true state, without images and estimators: thousands of steps a second.

    A step lasts `frames` frames. An episode is truncated after the last frame of the plan, and terminated if the hull
    touches the floor or the left camera leaves the terrain.

    Observation (dictionary; `observe` selects, all are bounded, and values beyond the bounds are cut off):
        pose: (7,) true pose of the left camera: x, y, z [m], quaternion x, y, z, w.
        velocity: (6,) true angular rate [rad/s] and velocity [m/s] of the body in its axes.
        reference: (4,) planned x, y, z [m] of the left camera and yaw [rad] at this time.
        readings, available: as `SeabedTwinEnv`, with the noise of the scenario.

    Action: as `SeabedTwinEnv`; the controller steers by the true pose.

    Reward of a step: "track", minus the distance of the left camera from its planned position [m], or a function of
    the environment.

    Args:
        scenario, overrides: as `SeabedTwinEnv`; the world is that of the surrogate.
        observe: names of the observations.
        reward: "track", or a function that gets this environment and returns the reward of its last step.
        frames: number of frames of a step.
    """

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(
        self, scenario: str = "quickstart", overrides: Sequence[str] = (),
        action: Literal["velocity", "thrust"] = "velocity",
        observe: Sequence[str] = ("pose", "velocity", "reference"),
        reward: Literal["track"] | Callable[["SeabedTwinStateEnv"], float] = "track",
        frames: int = 1, allow_plugins: bool = False,
    ):  # fmt: skip
        surrogate = ["imaging.fidelity=surrogate", "imaging.extrapolate=true"]
        given = load_scenario(scenario, [*overrides, *surrogate], allow_plugins)
        if unknown := [name for name in observe if name not in _BOUNDS]:
            raise TwinError("observe", f"{unknown[0]!r}: no such observation", ", ".join(_BOUNDS))
        if frames < 1:
            raise TwinError("frames", f"{frames}", "1 or more")
        if not callable(reward) and reward != "track":
            raise TwinError("reward", f"{reward!r}: no such reward", '"track", or a function of the environment')
        super().__init__(given, action)
        self._reward, self._frames = reward, frames
        self._limits = {name: np.array(_BOUNDS[name], np.float64) for name in observe}
        self.observation_space = spaces.Dict({n: spaces.Box(-b, b, dtype=np.float64) for n, b in self._limits.items()})

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Observation, dict[str, Any]]:
        """Starts an episode, as `SeabedTwinEnv.reset`."""
        super().reset(seed=seed)
        self._start()
        self._to_camera = geometry.adjoint(geometry.inverse(self.world.rig.body_from_camera))
        return self._observation(), {"time_s": self._frame.time_s, "ended": ""}

    def step(self, action: NDArray[np.float32]) -> tuple[Observation, SupportsFloat, bool, bool, dict[str, Any]]:
        """Applies an action for `frames` frames; returns observation, reward, terminated, truncated and info."""
        ended, truncated = self._fly(action, self._frames, ends_at_keyframe=False)
        reward = self._reward(self) if callable(self._reward) else -self.distance_m
        return self._observation(), reward, bool(ended), truncated, {"time_s": self._frame.time_s, "ended": ended}

    def _seen_by_controller(self) -> Estimate:
        pose, twist = self.world.true_pose, self._to_camera @ self.world.world.vehicle.twist_body
        return Estimate(self._frame.time_s, pose, pose, twist, 0.0, "ok")

    def _observation(self) -> Observation:
        pose, reference = self.world.true_pose, self.world.reference
        readings, available = _readings(self._frame)
        values = {
            "pose": np.append(pose[:3, 3], geometry.quaternion_xyzw(pose[:3, :3])),
            "velocity": self.world.world.vehicle.twist_body,
            "reference": np.append(reference.position, float(reference.yaw)),
            "readings": readings,
            "available": available.astype(np.float64),
        }
        return {name: np.clip(values[name], -limit, limit) for name, limit in self._limits.items()}


#: Largest absolute values of the observations of `SeabedTwinStateEnv`.
_BOUNDS: dict[str, Sequence[float]] = {
    "pose": [1e3] * 3 + [1.0] * 4,
    "velocity": [10.0] * 6,
    "reference": [1e3] * 3 + [10.0],
    "readings": [1e3, *[4.0] * 3, *[10.0] * 3],
    "available": [1.0] * 3,
}


def moved(last: Reference, values: Array, most_mps: float, interval_s: float) -> Reference:
    """Returns the target of the controller after an interval at a velocity (4,): forward, left, up and yaw rate."""
    yaw = float(last.yaw) + values[3] * YAW_RATE_RADPS * interval_s
    c, s = np.cos(yaw), np.sin(yaw)
    forward, left, up = values[:3] * most_mps
    velocity = np.array([c * forward - s * left, s * forward + c * left, up])
    return Reference(last.position + velocity * interval_s, velocity, yaw, np.zeros(3))


def _readings(frame: Frame) -> tuple[Array, NDArray[np.int8]]:
    """Returns the readings (7,) of pressure, attitude and DVL, zero where missing, and the mask (3,) of those given."""
    given = frame.readings
    parts = given.pressure_z_m, given.ahrs_rpy_rad, given.dvl_mps
    filled = [np.zeros(n) if part is None else np.atleast_1d(part) for n, part in zip((1, 3, 3), parts, strict=True)]
    return np.concatenate(filled).astype(np.float64), np.array([part is not None for part in parts], np.int8)


if ENVIRONMENT not in gymnasium.registry:
    gymnasium.register(ENVIRONMENT, entry_point="twin.gym:SeabedTwinEnv")
    gymnasium.register(STATE_ENVIRONMENT, entry_point="twin.gym:SeabedTwinStateEnv")
