"""From an estimate of the camera to the vehicle's command: it is steered by what it believes."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numba import njit

from controllers.segments import Reference
from controllers.tracking import Steering, commanded, commanded_velocity, level_arm
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Estimate
from twin.simulate.autopilot import nominal_pilot
from twin.world.mission import Mission

_VELOCITY_SMOOTHING_S = 0.1  # frame-to-frame velocity is noisy; the hull cannot change its own faster


PilotOfEstimates = Callable[[Estimate, Reference], Array]


def make_pilot(mission: Mission) -> PilotOfEstimates:
    """A pilot that flies on estimates alone: (estimate of the left camera, its reference) -> command of the vehicle."""
    return RovPilot(mission) if mission.scenario.vehicle.dynamics == "rigid" else _carrier_pilot(mission)


def _carrier_pilot(mission: Mission) -> PilotOfEstimates:
    """The pilot of a carrier that cannot turn, so that the camera moves as the body does: -> velocity (3,) [m/s]."""
    frequency = mission.scenario.control.natural_frequency_radps

    def command(estimate: Estimate, reference: Reference) -> Array:
        return commanded_velocity(estimate.world_from_camera[:3, 3], reference, frequency)

    return command


class Helm(NamedTuple):
    """What the pilot of the ROV goes by.

    Args:
        camera_from_body, to_body: (4, 4) of the body, and (6, 6) that carries a twist of the camera to the body.
        lever_arm_m: (3,) of the camera in the body.
        smoothing: share of a new velocity.
        twist: (6,) smoothed, of the body, changed in place.
        steering: of the body.
    """

    camera_from_body: Array
    to_body: Array
    lever_arm_m: Array
    smoothing: float
    twist: Array
    steering: Steering


class RovPilot:
    """The pilot of the ROV: -> thruster commands (8,), -1 to 1."""

    def __init__(self, mission: Mission):
        rig = mission.rig
        self.helm = Helm(
            camera_from_body=geometry.inverse(rig.body_from_camera),
            to_body=geometry.adjoint(rig.body_from_camera),
            lever_arm_m=rig.body_from_camera[:3, 3].copy(),
            smoothing=1 / (1 + _VELOCITY_SMOOTHING_S * rig.frame_rate_hz),
            twist=np.zeros(6),
            steering=nominal_pilot(mission.scenario.control.natural_frequency_radps, rig.frame_rate_hz).steering,
        )

    def __call__(self, estimate: Estimate, reference: Reference) -> Array:
        return steer(
            self.helm, estimate.world_from_camera, estimate.camera_velocity, reference.position, reference.velocity,
            reference.acceleration, float(reference.yaw),
        )  # fmt: skip


@njit(cache=True, nogil=True)
def steer(helm, world_from_camera, camera_velocity, position, velocity, acceleration, yaw):
    """Commands for an estimated pose (4, 4) and twist (6,) of the camera, and its reference."""
    geometry.put(helm.twist, helm.twist + helm.smoothing * (helm.to_body @ camera_velocity - helm.twist))
    body = geometry.compose(world_from_camera, helm.camera_from_body)
    place = position - level_arm(yaw, helm.lever_arm_m)
    return commanded(helm.steering, body, helm.twist, place, velocity, acceleration, yaw)
