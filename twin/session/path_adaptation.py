"""Adaptation of the path in flight to the measured floor and to what plug-ins ask, and legs over gaps at its end."""

from functools import cached_property

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.quality import Gaps
from twin.core.records import Estimate, Frame
from twin.plugin.navigator import Estimators
from twin.plugin.protocols import LEAST_PACE, MOST_OFFSET_M, Situation
from twin.world.floor_following import FloorFollower
from twin.world.floor_forecast import planned_surface
from twin.world.gap_filling import GapFiller
from twin.world.mission_flight import Flight
from twin.world.path_checks import room_below_m
from twin.world.pilot import PilotOfEstimates, PluginPilot

_MOST_STEP_M, _MOST_RATE_MPS = 0.1, 0.1  # of the offset, at a keyframe and over time


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


class PluginAdaptation:
    """Asks a plug-in at every keyframe for offset and pace of the path, and limits them (`Adaptation`).

    A shifted path keeps the planned heights, plus the offset. It stays over the known floor, and clear of it and of its
    objects by `plan.clearance_m`: it is not lowered farther, and not shifted where it is too near with the largest
    shift. With `control.height`, the clearance of `follower` from the floor measured so far holds instead.
    """

    def __init__(self, flight: Flight, pilot: PluginPilot, follower: FloorFollower | None):
        self._flight, self._pilot, self._follower, self._mission = flight, pilot, follower, flight.mission
        self._floor = FloorFollower(flight.mission) if follower is None else follower
        self._offset_m, self._last_s = np.zeros(3), 0.0

    @property
    def adapts(self) -> bool:
        return self._pilot.adapts

    def adapt(self, frame: Frame, estimate: Estimate, points_m: Array | None) -> None:
        """Asks the plug-in at a keyframe; `points_m` are new stereo points (n, 3) in the world [m]."""
        if self._follower is None and points_m is not None:
            self._floor.add(points_m)
        if not frame.keyframe:
            return
        reference, floor_m = self._flight.reference, self._floor.floor_m
        asked = self._pilot.adaptation(Situation(frame.time_s, estimate, frame.readings, reference, floor_m))
        if asked is not None:
            least = 1.0 if self._mission.plan.flies_arcs else LEAST_PACE
            self._flight.pace_factor = float(np.clip(asked.pace, least, 1.0))
            self._shift(self._limited(asked.offset_m), frame.time_s - self._last_s)
        self._last_s = frame.time_s

    def _limited(self, offset_m: Array) -> Array:
        """Returns an offset (3,) within the limits of its size and of the extent of the known floor."""
        chart, path = self._mission.chart, self._mission.plan.outline()[:, :2]
        level = offset_m[:2] * (MOST_OFFSET_M / max(float(np.hypot(*offset_m[:2])), MOST_OFFSET_M))
        least, most = (chart.west_m, chart.south_m) - path.min(axis=0), (chart.east_m, chart.north_m) - path.max(axis=0)
        rises = self._mission.scenario.vehicle.dynamics == "rigid"
        return np.append(np.clip(level, least, most), rises * np.clip(offset_m[2], -MOST_OFFSET_M, MOST_OFFSET_M))

    def _shift(self, target_m: Array, interval_s: float) -> None:
        last, step = self._offset_m, target_m - self._offset_m
        most_m = min(_MOST_STEP_M, _MOST_RATE_MPS * interval_s)
        offset = last + step * (most_m / max(float(np.linalg.norm(step)), most_m, 1e-9))
        if self._follower is not None:
            self._follower.rise_m, self._follower.beside_m = float(offset[2]), MOST_OFFSET_M
            self._flight.shift(offset * [1.0, 1.0, 0.0])
        else:
            if -self._rooms_m[1] > last[2]:  # shifted, it would have to rise
                offset[:2] = 0.0
            is_shifted = bool(last[:2].any() or offset[:2].any())
            offset[2] = max(offset[2], -self._rooms_m[is_shifted])
            self._flight.shift(offset)
        self._offset_m = offset

    @cached_property
    def _rooms_m(self) -> list[float]:
        """Returns by how much the path may be lowered [m]: as planned, and shifted; the planned one is allowed."""
        mission, top = self._mission, planned_surface(self._mission)
        asked = mission.plan, mission.scenario.plan, mission.chart, top
        return [max(0.0, room_below_m(*asked, 0.0)), room_below_m(*asked, MOST_OFFSET_M)]
