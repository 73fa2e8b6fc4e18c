"""Pilot: computes the vehicle command from the online estimate of the camera's pose and velocity."""

from collections import deque
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from twin.controllers.segments import Reference
from twin.controllers.thruster_monitor import ThrusterMonitor
from twin.controllers.tracking import ControllerState, commanded_velocity, control_thrusters, rotate_lever_arm
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Estimate, Readings
from twin.errors import SurveyAborted
from twin.kernels import kernel
from twin.plugin.guard import GuardedPlugin
from twin.plugin.loading import CONTROLLERS
from twin.plugin.protocols import Adaptation, ControllerSetup, Situation
from twin.simulate.autopilot import allocation_without, nominal_controller, thruster_lag_s
from twin.simulate.fin_autopilot import fin_autopilot
from twin.simulate.parameters import moves_along_all_axes
from twin.world.computer import frames_of_latency
from twin.world.mission import Mission

#: Natural frequency of the position loop times the whole delay, at most; the attitude loop is twice as fast. At 0.3 rad
#: the survey of `reef` oscillates with a latency of 0.2 s, at 0.15 rad gusts move the vehicle twice as far.
_MOST_PHASE_RAD = 0.22
_VELOCITY_SMOOTHING_S = 0.1  # time constant of the filter: velocity from F2F is noisy, the true velocity varies slowly

#: Function from the estimate and the reference of the left camera to the vehicle command.
PilotOfEstimates = Callable[[Estimate, Reference], Array]


def make_pilot(mission: Mission, monitor: ThrusterMonitor | None = None) -> PilotOfEstimates:
    """Returns the pilot of a mission; raises TwinError if its plug-in cannot be loaded.

    The thrusters that `monitor` finds lost are left out; a plug-in is not told of them.
    """
    scenario = mission.scenario
    n_late = frames_of_latency(scenario)
    if scenario.control.plugin is not None:
        return PluginPilot(mission, scenario.control.plugin)
    if scenario.vehicle.is_steered_by_fins:
        return _late(AuvPilot(mission), n_late)
    if scenario.vehicle.dynamics == "rigid":
        return RovPilot(mission, monitor)
    return _late(partial(_kinematic_command, scenario.control.natural_frequency_radps), n_late)


def _late(pilot: PilotOfEstimates, n: int) -> PilotOfEstimates:
    """Returns a pilot whose commands are those of n frames ago, at first zero."""
    return pilot if n == 0 else partial(_command_of_before, deque(), pilot, n)


def _command_of_before(
    waiting: deque[Array], pilot: PilotOfEstimates, n: int, estimate: Estimate, reference: Reference
) -> Array:
    waiting.append(pilot(estimate, reference))
    return waiting.popleft() if len(waiting) > n else np.zeros_like(waiting[0])


def without_feedback(estimate: Estimate, reference: Reference, readings: Readings) -> Estimate:
    """Returns the estimate; position and velocity are those of the reference if they were predicted, not measured.

    If the pilot corrected a predicted deviation, the true vehicle would move by it, and no measurement would reveal
    this motion. The attitude is kept, and with a reading of the pressure sensor height and vertical velocity. Unchanged
    if the motion was measured or a DVL reading is available.
    """
    if estimate.is_measured or readings.dvl_mps is not None:
        return estimate
    pose, twist = estimate.world_from_camera.copy(), estimate.camera_velocity.copy()
    velocity = pose[:3, :3] @ twist[3:]
    n = 3 if readings.pressure_z_m is None else 2
    pose[:n, 3], velocity[:n] = reference.position[:n], reference.velocity[:n]
    twist[3:] = pose[:3, :3].T @ velocity
    return estimate._replace(world_from_camera=pose, camera_velocity=twist)


class PluginPilot:
    """Pilot that gives the commands of a plug-in; calls raise PluginFailed if what it returns is unusable."""

    def __init__(self, mission: Mission, name: str):
        scenario, rig = mission.scenario, mission.rig
        nominal = nominal_controller(scenario.vehicle, scenario.control.natural_frequency_radps, rig.frame_rate_hz)
        self._n = scenario.vehicle.n_commands if scenario.vehicle.dynamics == "rigid" else 3
        setup = ControllerSetup(rig, 1 / rig.frame_rate_hz, nominal.hull, nominal.allocation, self._n)
        self._plugin = GuardedPlugin("control.plugin", CONTROLLERS, name, ["command"], setup)
        self._command = _late(self._of_plugin, frames_of_latency(scenario))

    def __call__(self, estimate: Estimate, reference: Reference) -> Array:
        return self._command(estimate, reference)

    def _of_plugin(self, estimate: Estimate, reference: Reference) -> Array:
        return self._plugin.numbers("command", self._plugin.call("command", estimate, reference), (self._n,))

    @property
    def adapts(self) -> bool:
        """Returns whether the plug-in changes the path; known after the first command."""
        return self._plugin.has("adapt")

    def adaptation(self, situation: Situation) -> Adaptation | None:
        asked = self._plugin.call("adapt", situation)
        if asked is None:
            return None
        if not isinstance(asked, Adaptation):
            self._plugin.refuse("adapt", type(asked).__name__, "an Adaptation or None")
        numbers = self._plugin.numbers
        return Adaptation(numbers("adapt", asked.offset_m, (3,)), float(numbers("adapt", asked.pace, ())))


def _kinematic_command(frequency: float, estimate: Estimate, reference: Reference) -> Array:
    return commanded_velocity(estimate.world_from_camera[:3, 3], reference, frequency)


class PilotState(NamedTuple):
    """State and constants of the ROV's pilot; `twist`, `controller` and `waiting` are modified in place."""

    camera_from_body: Array  #: (4, 4) pose of the body in the left camera
    body_from_camera_twist: Array  #: (6, 6) adjoint that transforms a twist of the camera to the body
    lever_arm_m: Array  #: (3,) position of the left camera in the body
    smoothing: float  #: weight of a new twist in the exponential moving average
    twist: Array  #: (6,) smoothed twist of the body in body axes [rad/s, m/s]
    controller: ControllerState
    latency_s: float  #: time until a command reaches the thrusters
    waiting: Array  #: (k, n) commands that have not reached them, the oldest first


class AuvPilot:
    """Pilot of a vehicle with fins; a command (n,) in [-1, 1] per thruster, then movable fin, after the latency."""

    def __init__(self, mission: Mission):
        rig, scenario = mission.rig, mission.scenario
        self._camera_from_body, self._lever_arm_m = geometry.inverse(rig.body_from_camera), rig.body_from_camera[:3, 3]
        self._from_camera_twist = geometry.adjoint(rig.body_from_camera)
        self._smoothing = 1 / (1 + _VELOCITY_SMOOTHING_S * rig.frame_rate_hz)
        self._twist: Array | None = None
        self._late_s = frames_of_latency(scenario) / rig.frame_rate_hz
        self._allocation = nominal_controller(scenario.vehicle, 1.0, rig.frame_rate_hz).allocation
        self._autopilot = fin_autopilot(scenario.vehicle, mission.plan.speed_mps, rig.frame_rate_hz)
        self._n_thrusters = len(scenario.vehicle.thrusters)

    def __call__(self, estimate: Estimate, reference: Reference) -> Array:
        yaw, late_s, body = float(reference.yaw), self._late_s, estimate.world_from_camera @ self._camera_from_body
        if self._twist is None:  # at the first frame, no velocity is measured
            self._twist = np.concatenate([np.zeros(3), body[:3, :3].T @ reference.velocity])
        else:
            measured = self._from_camera_twist @ estimate.camera_velocity
            self._twist = self._twist + self._smoothing * (measured - self._twist)
        body = body @ geometry.exp(late_s * self._twist)
        velocity = reference.velocity + late_s * reference.acceleration
        target = reference.position - rotate_lever_arm(yaw, self._lever_arm_m)
        target = target + late_s * (reference.velocity + velocity) / 2
        acceleration, is_measured = reference.acceleration, estimate.is_measured
        inputs = self._autopilot.inputs(body, self._twist, target, velocity, acceleration, is_measured)
        n, allocation = self._n_thrusters, self._allocation
        thrusts = np.interp(inputs[:n], allocation.thrust_table_n, allocation.command_table)
        return np.concatenate([thrusts, inputs[n:] / self._autopilot.most[n:]])


class RovPilot:
    """Pilot of the ROV; a command (n,) in [-1, 1] per thruster, without lost ones; SurveyAborted if too many are."""

    def __init__(self, mission: Mission, monitor: ThrusterMonitor | None = None):
        self._vehicle, self._monitor, self._n_lost = mission.scenario.vehicle, monitor, 0
        rig, scenario, n_late = mission.rig, mission.scenario, frames_of_latency(mission.scenario)
        frequency, latency_s = scenario.control.natural_frequency_radps, n_late / rig.frame_rate_hz
        if n_late:
            delay_s = latency_s + _VELOCITY_SMOOTHING_S + thruster_lag_s(scenario.vehicle)
            frequency = min(frequency, _MOST_PHASE_RAD / delay_s)
        self.state = PilotState(
            camera_from_body=geometry.inverse(rig.body_from_camera),
            body_from_camera_twist=geometry.adjoint(rig.body_from_camera),
            lever_arm_m=rig.body_from_camera[:3, 3].copy(),
            smoothing=1 / (1 + _VELOCITY_SMOOTHING_S * rig.frame_rate_hz), twist=np.zeros(6),
            controller=nominal_controller(
                scenario.vehicle, frequency, rig.frame_rate_hz, _VELOCITY_SMOOTHING_S + latency_s
            ),
            latency_s=latency_s, waiting=np.zeros((n_late, len(scenario.vehicle.thrusters))),
        )  # fmt: skip

    def __call__(self, estimate: Estimate, reference: Reference) -> Array:
        if self._monitor is not None and len(self._monitor.lost) > self._n_lost:
            self._leave_out([thruster.number - 1 for thruster in self._monitor.lost])
        return steer(
            self.state, estimate.world_from_camera, estimate.camera_velocity, reference.position, reference.velocity,
            reference.acceleration, float(reference.yaw), estimate.is_measured,
        )  # fmt: skip

    def _leave_out(self, lost: list[int]) -> None:
        self._n_lost = len(lost)
        if not moves_along_all_axes(self._vehicle, lost):
            names = ", ".join(str(k + 1) for k in sorted(lost))
            raise SurveyAborted(
                f"thrusters {names} do not push as commanded: the others cannot push along all axes and turn about the"
                " vertical"
            )
        allocation = allocation_without(self._vehicle, lost)
        self.state = self.state._replace(controller=self.state.controller._replace(allocation=allocation))


@kernel
def steer(state, world_from_camera, camera_velocity, position, velocity, acceleration, yaw, is_measured=True):
    """Returns the thruster commands (n,) and updates `state` in place; compiled kernel of `RovPilot`."""
    # With a latency, pose and reference are predicted to the time at which the command reaches the thrusters.
    change = state.body_from_camera_twist @ camera_velocity - state.twist
    geometry.copy_into(state.twist, state.twist + state.smoothing * change)
    body = geometry.compose(world_from_camera, state.camera_from_body)
    target = position - rotate_lever_arm(yaw, state.lever_arm_m)
    if len(state.waiting) == 0:
        return control_thrusters(state.controller, body, state.twist, target, velocity, acceleration, yaw, is_measured)
    late_s = state.latency_s
    body = geometry.compose(body, geometry.exp(late_s * state.twist))
    target = target + late_s * velocity + 0.5 * late_s**2 * acceleration
    velocity = velocity + late_s * acceleration
    commands = control_thrusters(state.controller, body, state.twist, target, velocity, acceleration, yaw, is_measured)
    first = state.waiting[0].copy()
    for k in range(len(state.waiting) - 1):
        state.waiting[k] = state.waiting[k + 1]
    state.waiting[-1] = commands
    return first
