"""Faults of thrusters, cameras, lamps, sensors and water: when each is active, and its effect on commands and data."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import replace
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import Image, Readings, StereoRig
from twin.scenario.model import FaultConfig
from twin.simulate.sea import GUST_RISE_S
from twin.simulate.tether import Tether

_READING_OF = {"pressure": "pressure_z_m", "ahrs": "ahrs_rpy_rad", "dvl": "dvl_mps", "usbl": "usbl_m"}
_LEAST_SILT = 0.02  # share of the contrast below which a cloud has gone
_CAMERAS_OF = {"cameras": (0, 1), "left_camera": (0,), "right_camera": (1,)}
_RISE_S, _SETTLE_S = 1.0, 3.0  # a cloud of silt rises within this time, and settles at this rate once it ends
_NOISE = 1.5  # standard deviation of the noise of an image of silt alone [grey levels]
_NEAR, _FAR = 0.3, 0.7  # fish swim at these shares of the distance to the floor
_LENGTHS_M, _SPEEDS_MPS, _GREYS = (0.1, 0.3), (0.1, 0.5), (40, 140)
_SLENDERNESS = 0.35  # height of a fish / its length


class FaultEvent(NamedTuple):
    """Start or end of a fault."""

    time_s: float
    fault: FaultConfig
    starts: bool

    @property
    def described(self) -> dict[str, Any]:
        return {"time_s": self.time_s, "part": self.fault.name, "type": self.fault.type, "starts": self.starts}


class Faults:
    """Faults of a survey; a fault of a rate per hour starts at random times, exponentially distributed.

    Calls are in the order of time: first `at`, then the functions that change commands, images and readings. Faults of
    a rate start up to `duration_s`; what drifts before the cameras depends on rig and distance to the floor [m].
    """

    def __init__(
        self, faults: Sequence[FaultConfig], duration_s: float, rng: np.random.Generator, rig: StereoRig, floor_m: float
    ):
        self._rng, self._rig, self._floor_m, self._time_s = rng, rig, floor_m, 0.0
        self._spans = [(fault, span) for fault in faults for span in _spans(fault, duration_s, rng)]
        self._of_places = [fault for fault in faults if fault.at_m is not None]  # that the vehicle has not reached
        self._gusts = [fault for fault in faults if fault.type == "gust"]
        self._active: list[FaultConfig] = []
        self._all = list(faults)
        self._kept: dict[tuple[object, object], Any] = {}  # by fault and kind of data: what a stuck part repeats
        self.events: list[FaultEvent] = []
        self.exist = bool(faults)

    def at(self, time_s: float, camera_m: Array) -> None:
        """Sets the time of the following calls and adds `events`; `camera_m` (3,), true, starts faults of a place."""
        self._time_s = time_s
        for fault in [one for one in self._of_places if math.dist(one.at_m or (), camera_m[:2]) <= one.radius_m]:
            self._of_places.remove(fault)
            self._spans.append((fault, (time_s, time_s + (fault.duration_s or np.inf))))
        active = [fault for fault, (start, end) in self._spans if start - 1e-9 <= time_s < end - 1e-9]
        for starts, new, old in ((True, active, self._active), (False, self._active, active)):
            for fault in new:
                if not any(fault is other for other in old):
                    self.events.append(FaultEvent(time_s, fault, starts))
        ended = {self._number(fault) for fault in self._active} - {self._number(fault) for fault in active}
        self._kept = {key: value for key, value in self._kept.items() if key[0] not in ended}
        self._active = active

    @property
    def sentences(self) -> list[str]:
        """Returns a sentence on the faults that have occurred."""
        starts = (event for event in self.events if event.starts)
        began = [f"{fault.name} {fault.type} at {time_s:.1f} s" for time_s, fault, _ in starts]
        return [f"Simulated faults: {', '.join(began)}."] if began else []

    def thrusts(self, command: Array) -> tuple[Array, Array]:
        """Returns the commands (n,) that reach the thrusters, and the factors (n,) on their thrusts."""
        command, factors = np.array(command, float), np.ones(len(command))
        for fault in self._of("thruster"):
            k = (fault.number or 1) - 1
            if fault.type == "stuck":
                command[k] = self._kept.setdefault((self._number(fault), "command"), command[k])
            elif fault.type == "wrong":
                factors[k] *= fault.size
            elif self._is_lost(fault):
                factors[k] = 0.0
        return command, factors

    def catch_tether(self, tether: Tether, position_m: Array) -> None:
        """Catches the tether at the position (3,) of its attachment, or lets it go."""
        caught = self._of("tether")
        if not caught:
            tether.snag[:] = 0.0
        elif tether.snag[0] == 0.0:
            tether.snag[:] = 1.0, *position_m, caught[0].size

    def blow(self, single_gusts: Array, port: Array) -> None:
        """Lets gusts begin and end; `port` (3,) is the direction to port of the vehicle."""
        for row, fault in zip(single_gusts, self._gusts, strict=True):
            if any(fault is one for one in self._active):
                if row[0] > self._time_s or row[1] + GUST_RISE_S <= self._time_s:  # after the fall of the last one
                    to_port, given_deg = np.arctan2(port[1], port[0]), fault.direction_deg
                    angle = to_port if given_deg is None else np.deg2rad(given_deg)
                    row[:] = self._time_s, np.inf, fault.size * np.cos(angle), fault.size * np.sin(angle), 0.0
            elif np.isinf(row[1]) and row[0] <= self._time_s:
                row[1] = self._time_s

    def lamps_lit(self, n: int) -> NDArray[np.bool_]:
        """Returns which of n lamps are lit."""
        lit = np.ones(n, np.bool_)
        for fault in self._of("lamp"):
            if self._is_lost(fault):
                lit[slice(None) if fault.number is None else fault.number - 1] = False
        return lit

    def images(self, *images: Image | None) -> list[Image | None]:
        """Returns the images (h, w, 3) of the left and the right camera as they are delivered."""
        delivered = self._views(*images)
        for fault in self._of(*_CAMERAS_OF):
            lost = fault.type == "garbage" or fault.type == "stuck" or self._is_lost(fault)
            for k in _CAMERAS_OF[fault.part]:
                image = delivered[k]
                if image is not None and lost:
                    delivered[k] = self._faulty_image(fault, k, image)
        return delivered

    def _views(self, *images: Image | None) -> list[Image | None]:
        """Returns the images (h, w, 3) of the left and the right camera behind silt and fish."""
        seen = list(images)
        for n, (fault, (start_s, end_s)) in enumerate(self._spans):
            since_s = self._time_s - start_s
            if fault.type == "silt" and since_s >= 0:
                settled = float(np.exp(-max(0.0, self._time_s - end_s) / _SETTLE_S))
                risen = min(1.0, min(since_s, end_s - start_s) / _RISE_S)
                share = min(fault.size, 1.0) * risen * settled  # of the contrast
                if share > _LEAST_SILT:
                    seen = [image if image is None else behind_silt(image, share, self._rng) for image in seen]
            elif fault.part == "fish" and 0 <= since_s < end_s - start_s:
                school = self._kept.setdefault(("school", n), new_school(max(1, round(fault.size)), self._rng))
                seen = [
                    image if image is None else behind_fish(image, school, since_s, k, self._rig, self._floor_m)
                    for k, image in enumerate(seen)
                ]
        return seen

    def _faulty_image(self, fault: FaultConfig, camera: int, image: Image) -> Image:
        if fault.type == "stuck":
            kept: Image = self._kept.setdefault((self._number(fault), camera), image)
            return kept
        if fault.type == "garbage":
            return self._rng.integers(0, 256, image.shape, np.uint8)
        return np.zeros_like(image)

    def readings(self, readings: Readings) -> Readings:
        for fault in self._of(*_READING_OF):
            name = _READING_OF[fault.part]
            value = getattr(readings, name)
            if fault.type == "delayed":
                readings = replace(readings, **{name: self._late_reading(fault, value)})
            elif value is not None:
                readings = replace(readings, **{name: self._faulty_reading(fault, value)})
        return readings

    def _faulty_reading(self, fault: FaultConfig, value: Any) -> Any:
        if fault.type == "stuck":
            return self._kept.setdefault((self._number(fault), "reading"), value)
        if fault.type in ("wrong", "garbage"):
            size = np.deg2rad(fault.size) if fault.part == "ahrs" else fault.size
            return value + size * (self._rng.standard_normal(np.shape(value)) if fault.type == "garbage" else 1.0)
        return None if self._is_lost(fault) else value

    def _late_reading(self, fault: FaultConfig, value: Any) -> Any:
        """Returns the newest reading that arrives now, None if none does."""
        waiting, found = self._kept.setdefault((self._number(fault), "readings"), []), None
        if value is not None:
            waiting.append((self._time_s + fault.size, value))
        while waiting and waiting[0][0] <= self._time_s + 1e-9:
            found = waiting.pop(0)[1]
        return found

    def _number(self, fault: FaultConfig) -> int:
        return next(k for k, one in enumerate(self._all) if one is fault)

    def _is_lost(self, fault: FaultConfig) -> bool:
        return fault.type == "off" or (fault.type == "intermittent" and self._rng.uniform() < fault.size)

    def _of(self, *parts: str) -> list[FaultConfig]:
        return [fault for fault in self._active if fault.part in parts]


def _spans(fault: FaultConfig, duration_s: float, rng: np.random.Generator) -> Iterator[tuple[float, float]]:
    """Yields start and end of each occurrence of a fault [s]."""
    lasting_s = fault.duration_s or np.inf
    if fault.start_s is not None:
        yield fault.start_s, fault.start_s + lasting_s
    if fault.per_hour is None:
        return
    time_s = float(rng.exponential(3600 / fault.per_hour))
    while time_s < duration_s:
        yield time_s, time_s + lasting_s
        time_s += lasting_s + float(rng.exponential(3600 / fault.per_hour))


def behind_silt(image: Image, share: float, rng: np.random.Generator) -> Image:
    """Returns an image that has lost a share of its contrast, at equal brightness; the noise of the camera remains."""
    seen = image.mean(axis=(0, 1)) * share + image * (1 - share)
    seen += rng.standard_normal(image.shape) * (_NOISE * np.sqrt(1 - (1 - share) ** 2))
    return np.clip(np.rint(seen), 0, 255).astype(np.uint8)


class School(NamedTuple):
    """Fish that swim through the view at constant velocities and come back on the other side."""

    share: Array  #: (n,) distance from the cameras / distance to the floor
    start: Array  #: (n, 2) position in the view at the start, fractions of its sides
    velocity_mps: Array  #: (n, 2) velocity along the columns and the rows
    length_m: Array  #: (n,)
    grey: Array  #: (n,)


def new_school(n: int, rng: np.random.Generator) -> School:
    angle = rng.uniform(-np.pi, np.pi, n)
    direction = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return School(
        rng.uniform(_NEAR, _FAR, n), rng.uniform(0, 1, (n, 2)), direction * rng.uniform(*_SPEEDS_MPS, (n, 1)),
        rng.uniform(*_LENGTHS_M, n), rng.uniform(*_GREYS, n),
    )  # fmt: skip


def behind_fish(image: Image, school: School, time_s: float, camera: int, rig: StereoRig, floor_m: float) -> Image:
    """Returns an image of the left (0) or right (1) camera with a school between it and a floor at a distance [m]."""
    drawn = image.copy()
    for share, start, velocity, length_m, grey in zip(*school, strict=True):
        px_per_m = rig.focal_px / (share * floor_m)
        long, around = length_m * px_per_m / 2, np.array([rig.width_px, rig.height_px])
        room = around + 2 * long
        at = (start * room + velocity * px_per_m * time_s) % room - long
        at[0] -= camera * rig.baseline_m * px_per_m
        angle = float(np.degrees(np.arctan2(velocity[1], velocity[0])))
        centre, axes = (
            (round(float(at[0])), round(float(at[1]))),
            (max(1, round(long)), max(1, round(long * _SLENDERNESS))),
        )
        cv2.ellipse(drawn, centre, axes, angle, 0, 360, (grey, grey, grey), -1)
        cv2.ellipse(drawn, centre, axes, angle, 20, 160, (grey / 2,) * 3, -1)  # its darker back
    return drawn
