"""From an estimate of the camera to the vehicle's command: it is steered by what it believes."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from controllers.segments import Reference
from controllers.tracking import body_reference, commanded_velocity
from twin import geometry
from twin.geometry import Array
from twin.mission import Mission
from twin.records import Estimate
from twin.simulate.autopilot import nominal_pilot

_VELOCITY_SMOOTHING_S = 0.1  # frame-to-frame velocity is noisy; the hull cannot change its own faster


PilotOfEstimates = Callable[[Estimate, Reference], Array]


def make_pilot(mission: Mission) -> PilotOfEstimates:
    """A pilot that flies on estimates alone: (estimate of the left camera, its reference) -> command of the vehicle."""
    return _rov_pilot(mission) if mission.scenario.vehicle.dynamics == "rigid" else _carrier_pilot(mission)


def _carrier_pilot(mission: Mission) -> PilotOfEstimates:
    """The pilot of a carrier that cannot turn, so that the camera moves as the body does: -> velocity (3,) [m/s]."""
    frequency = mission.scenario.control.natural_frequency_radps

    def command(estimate: Estimate, reference: Reference) -> Array:
        return commanded_velocity(estimate.world_from_camera[:3, 3], reference, frequency)

    return command


def _rov_pilot(mission: Mission) -> PilotOfEstimates:
    """The pilot of the ROV: -> thruster commands (8,), -1 to 1."""
    rig = mission.rig
    camera_from_body = geometry.inverse(rig.body_from_camera)
    to_body = geometry.adjoint(rig.body_from_camera)
    smoothing = 1 / (1 + _VELOCITY_SMOOTHING_S * rig.frame_rate_hz)
    pilot = nominal_pilot(mission.scenario.control.natural_frequency_radps, rig.frame_rate_hz)
    twist = np.zeros(6)

    def command(estimate: Estimate, reference: Reference) -> Array:
        nonlocal twist
        twist = twist + smoothing * (to_body @ estimate.camera_velocity - twist)
        body = estimate.world_from_camera @ camera_from_body
        return pilot.command(body, twist, body_reference(reference, rig.body_from_camera[:3, 3]))

    return command
