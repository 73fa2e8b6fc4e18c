"""Left of the wall: vehicle, floor, light, sensors; frames come out, thruster commands go in, truth is kept beside."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.growing_array import Rows
from twin.core.records import Frame, Image, StereoRig, Trajectory, Truth
from twin.estimate.pipeline import Navigator
from twin.estimate.stereo_vision import Vision
from twin.simulate.carrier import Carrier
from twin.simulate.free_body import FreeBody
from twin.simulate.sensors import NavigationSensors
from twin.world.coverage import true_heights
from twin.world.mission import Course, Mission, Step
from twin.world.pilot import PilotOfEstimates

if TYPE_CHECKING:
    from twin.simulate.vehicle import Vehicle

#: Streams of randomness, in this order for ever: a draw of one never depends on another.
_STREAMS = ("left_camera", "right_camera", "navigation", "dvl", "usbl", "beacons", "snow", "surrogate")


Watch = Callable[[str], AbstractContextManager[None]]
#: Flies the frames of a course from this one on, up to the next keyframe; returns the next frame.
Glide = Callable[[Course, int], int]


class CameraImages(NamedTuple):
    """What the cameras give: images (H, W, 3), and true depth (H, W) of the left one [m] for those who ask."""

    left: Image
    right: Image | None
    depth_m: Callable[[], NDArray[np.float32]]


class World(ABC):
    """The simulated world of a mission. Use as a context manager.

    Attributes:
        vision: answers the questions of the method itself, where nothing is rendered; None: ask the images.
        warnings: what the user should know of this world.
    """

    vision: Vision | None = None
    warnings: tuple[str, ...] = ()

    def __init__(
        self, mission: Mission, watch: Watch, vehicle: Vehicle | FreeBody | Carrier, sensors: NavigationSensors
    ):
        self.mission, self.watch, self.vehicle, self.sensors = mission, watch, vehicle, sensors
        self._true_poses = Rows(4, 4)
        self._courses: list[tuple[Array, bool, int]] = []  # planned positions (n, 3), station keeping, track

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Gives back what the world held."""

    @abstractmethod
    def look(self, step: Step) -> CameraImages:
        """What the cameras see now."""

    @abstractmethod
    def seen(self) -> NDArray[np.bool_]:
        """(rows, cols) cells of the map that at least one keyframe truly saw with both cameras."""

    @property
    def world_from_camera(self) -> Array:
        """(4, 4) true pose of the left camera."""
        return left_camera(self.vehicle, self.mission.rig)

    def begin(self, course: Course, track: int) -> None:
        """The frames that follow are those of this course, all of them unless the survey breaks off."""
        self._courses.append((course.reference.position, course.holding, track))

    def observe(self, step: Step) -> Frame:
        """What the vehicle sees now; the truth of it is kept here."""
        index, sight = len(self), self.look(step)
        self.record(self.world_from_camera)
        time_s = index / self.mission.rig.frame_rate_hz
        depth_m = sight.depth_m if step.keyframe else None
        readings = self.sensors.read(time_s, self.vehicle.world_from_body, self.vehicle.twist_body, depth_m)
        return Frame(index, time_s, sight.left, sight.right, readings)

    def act(self, command: Array) -> None:
        """One frame of physics under a pilot's command."""
        with self.watch("physics"):
            self.vehicle.step(command, 1 / self.mission.rig.frame_rate_hz)

    def __len__(self) -> int:
        """Frames so far."""
        return len(self._true_poses)

    def record(self, poses: Array) -> None:
        """Keeps the truth of one frame or more: true poses (4, 4) or (n, 4, 4)."""
        self._true_poses.add(poses)

    def glide(self, navigator: Navigator, pilot: PilotOfEstimates) -> Glide | None:
        """The closed loop over many frames at once, for a world that needs no image of them; None: frame by frame."""
        return None

    def truth(self) -> Truth:
        """All that the judge needs."""
        n, courses = len(self), [(np.empty((0, 3)), False, 0), *self._courses]
        lengths = [len(positions) for positions, _, _ in courses]
        return Truth(
            trajectory=Trajectory(np.arange(n) / self.mission.rig.frame_rate_hz, self._true_poses.array),
            reference=np.concatenate([positions for positions, _, _ in courses])[:n],
            holding=np.repeat([holding for _, holding, _ in courses], lengths)[:n],
            track=np.repeat([track for _, _, track in courses], lengths)[:n],
            height_m=true_heights(self.mission.grid, self.mission.terrain.height_at),
            seen=self.seen(),
        )


def left_camera(vehicle: Vehicle | FreeBody | Carrier, rig: StereoRig) -> Array:
    """(4, 4) world_from_camera of the left one, where the vehicle is now."""
    return geometry.compose(vehicle.world_from_body, rig.body_from_camera)


def streams(seed: int) -> dict[str, np.random.Generator]:
    """Every stream of randomness of a survey by name."""
    seeds = np.random.SeedSequence(seed).spawn(len(_STREAMS))
    return {name: np.random.default_rng(seed) for name, seed in zip(_STREAMS, seeds, strict=True)}
