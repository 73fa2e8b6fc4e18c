"""Adaptation of the path in flight: its height to the floor that was measured, and legs over gaps at its end."""

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import Gaps
from twin.core.records import Estimate, Frame
from twin.plugin.navigator import Estimators
from twin.session.plugin_adaptation import PluginAdaptation
from twin.world.floor_following import FloorFollower
from twin.world.gap_filling import GapFiller
from twin.world.mission_flight import Flight
from twin.world.pilot import PilotOfEstimates, PluginPilot


class PathAdaptation:
    """Adapts the path of a flight as `control.height`, `plan.fill_gaps` and a plug-in ask; by default, not."""

    def __init__(self, flight: Flight, pilot: PilotOfEstimates):
        scenario = flight.mission.scenario
        self._flight, self._n_keyframes = flight, 0
        self._follower = None if scenario.control.height == "planned" else FloorFollower(flight.mission)
        self._filler = GapFiller(flight.mission) if scenario.plan.fill_gaps else None
        self._plugin = PluginAdaptation(flight, pilot, self._follower) if isinstance(pilot, PluginPilot) else None
        if self._filler is not None:
            flight.further_path = self._filler.path

    def __call__(self, frame: Frame, estimate: Estimate, estimators: Estimators) -> None:
        """Uses what the estimators have measured at a frame, before the vehicle moves on from it."""
        if self._follower is None and self._filler is None and self._plugin is None:
            return
        points_m = self._new_points_m(estimators)
        if self._filler is not None and points_m is not None:
            self._filler.add(points_m)
        if self._follower is not None:
            surface = self._follower.found(frame, estimate, points_m)
            if surface is not None:
                self._flight.follow(surface)
        if self._plugin is not None and self._plugin.adapts:
            self._plugin.adapt(frame, estimate, points_m)

    def _new_points_m(self, estimators: Estimators) -> Array | None:
        """Returns the stereo points (n, 3) in the world [m] of a keyframe made since the last call; None without."""
        keyframes = estimators.network.keyframes
        new, self._n_keyframes = len(keyframes) > self._n_keyframes, len(keyframes)
        if not new or keyframes[-1].points is None:
            return None
        return geometry.transform(keyframes[-1].world_from_camera, keyframes[-1].points.xyz)

    @property
    def gaps(self) -> Gaps:
        return Gaps() if self._filler is None else self._filler.gaps
