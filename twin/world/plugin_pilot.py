"""Pilot that passes estimates to a controller of another package (`control.plugin`)."""

from __future__ import annotations

from twin.controllers.segments import Reference
from twin.core.geometry import Array
from twin.core.records import Estimate
from twin.plugin.guard import GuardedPlugin
from twin.plugin.loading import CONTROLLERS
from twin.plugin.protocols import ControllerSetup
from twin.simulate.autopilot import nominal_controller
from twin.world.mission import Mission


class PluginPilot:
    """Pilot that returns the checked commands of a plug-in.

    Args:
        mission: the survey to fly.
        name: value of `control.plugin`.

    Raises:
        TwinError: the plug-in cannot be loaded.
    """

    def __init__(self, mission: Mission, name: str):
        scenario, rig = mission.scenario, mission.rig
        nominal = nominal_controller(scenario.control.natural_frequency_radps, rig.frame_rate_hz).state
        self._n = 8 if scenario.vehicle.dynamics == "rigid" else 3
        setup = ControllerSetup(rig, 1 / rig.frame_rate_hz, nominal.hull, nominal.allocation, self._n)
        self._plugin = GuardedPlugin("control.plugin", CONTROLLERS, name, ["command"], setup)

    def __call__(self, estimate: Estimate, reference: Reference) -> Array:
        """Returns the command of the plug-in; raises PluginFailed if the plug-in fails or its command is unusable."""
        return self._plugin.numbers("command", self._plugin.call("command", estimate, reference), (self._n,))
