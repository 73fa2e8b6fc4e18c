"""Left of the wall: vehicle, floor, light, sensors; frames come out, thruster commands go in, truth is kept beside."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import replace
from typing import NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

import scenes.builder
from twin.estimate.vision import Vision
from twin.geometry import Array
from twin.imaging.camera import StereoCamera
from twin.imaging.light import Light
from twin.imaging.renderer import Renderer
from twin.judge.coverage import Coverage, true_heights
from twin.mission import Mission, Step
from twin.records import Frame, Image, Trajectory, Truth
from twin.simulate.carrier import Carrier
from twin.simulate.free_body import FreeBody
from twin.simulate.sensors import NavigationSensors
from twin.simulate.vehicle import Vehicle, physics_timestep_s

#: Streams of randomness, in this order for ever: a draw of one never depends on another.
_STREAMS = ("left_eye", "right_eye", "navigation", "dvl", "usbl", "beacons", "snow", "surrogate")


Watch = Callable[[str], AbstractContextManager[None]]


class Sight(NamedTuple):
    """What the cameras give: images (H, W, 3), and true depth (H, W) of the left one [m] for those who ask."""

    left: Image
    right: Image | None
    depth_m: Callable[[], NDArray[np.float32]]


class Sea(ABC):
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
        self.true_poses: list[Array] = []
        self.steps: list[tuple[int, Step]] = []

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Gives back what the world held."""

    @abstractmethod
    def look(self, step: Step) -> Sight:
        """What the cameras see now."""

    @abstractmethod
    def seen(self) -> NDArray[np.bool_]:
        """(rows, cols) cells of the map that at least one key point truly saw with both eyes."""

    @property
    def world_from_camera(self) -> Array:
        """(4, 4) true pose of the left camera."""
        return self.vehicle.world_from_body @ self.mission.rig.body_from_camera

    def observe(self, step: Step, track: int) -> Frame:
        """What the vehicle sees now; the truth of it is kept here."""
        index = len(self.true_poses)
        sight = self.look(step)
        self.true_poses.append(self.world_from_camera)
        self.steps.append((track, step))
        time_s = index / self.mission.rig.frame_rate_hz
        depth_m = sight.depth_m if step.key_point else None
        readings = self.sensors.read(time_s, self.vehicle.world_from_body, self.vehicle.twist_body, depth_m)
        return Frame(index, time_s, sight.left, sight.right, readings)

    def act(self, command: Array) -> None:
        """One frame of physics under a pilot's command."""
        with self.watch("physics"):
            self.vehicle.step(command, 1 / self.mission.rig.frame_rate_hz)

    def truth(self) -> Truth:
        """All that the judge needs."""
        n = len(self.true_poses)
        times = np.arange(n) / self.mission.rig.frame_rate_hz
        return Truth(
            trajectory=Trajectory(times, np.array(self.true_poses).reshape(n, 4, 4)),
            reference=np.array([s.reference.position for _, s in self.steps]).reshape(n, 3),
            holding=np.array([s.holding for _, s in self.steps], dtype=bool),
            track=np.array([track for track, _ in self.steps], dtype=np.int64),
            height_m=true_heights(self.mission.grid, self.mission.terrain.height_at),
            seen=self.seen(),
        )


class RenderedSea(Sea):
    """Rendered by MuJoCo and lit by the project's own optics; it holds a GL context."""

    def __init__(self, mission: Mission, watch: Watch):
        scenario, view = mission.scenario, mission.view
        rig, rng = view.rig, streams(scenario.seed)
        vfov_deg = float(np.rad2deg(2 * np.arctan(rig.height_px / 2 / rig.focal_px)))
        world = scenes.builder.build(
            mission.terrain, rig.width_px, rig.height_px, vfov_deg, rig.baseline_m, rig.body_from_camera,
            physics_timestep_s(rig.frame_rate_hz), [lamp.position_m for lamp in scenario.lamps],
        )  # fmt: skip
        vehicle = (
            Vehicle(world, scenario.vehicle, np.array(scenario.current.velocity_mps), mission.start_of_body)
            if scenario.vehicle.dynamics == "rigid"
            else Carrier(mission.start_of_body)
        )
        noise, believed = scenario.believed_noise(), mission.rig
        super().__init__(
            mission, watch, vehicle, NavigationSensors(scenario.navigation, noise, believed, rng, view.project)
        )
        self.renderer = Renderer(world, rig.width_px, rig.height_px, vfov_deg)
        light = Light(scenario, mission.terrain, rng["snow"], rig)
        self.camera = StereoCamera(self.renderer, light, scenario, rng["left_eye"], rng["right_eye"], watch, view)
        self.coverage = Coverage(mission.grid, replace(believed, baseline_m=rig.baseline_m))

    def close(self) -> None:
        self.renderer.close()

    def look(self, step: Step) -> Sight:
        shot = self.camera.shoot(self.world_from_camera, step.key_point, self.vehicle.twist_body)
        if shot.depth_right is not None:
            self.coverage.add(self.world_from_camera, shot.depth_left, shot.depth_right)
        return Sight(shot.left, shot.right, lambda: shot.depth_left)

    def seen(self) -> NDArray[np.bool_]:
        return self.coverage.seen


def streams(seed: int) -> dict[str, np.random.Generator]:
    """Every stream of randomness of a survey by name."""
    seeds = np.random.SeedSequence(seed).spawn(len(_STREAMS))
    return {name: np.random.default_rng(seed) for name, seed in zip(_STREAMS, seeds, strict=True)}
