"""Left of the wall: vehicle, floor, light, sensors; frames come out, thruster commands go in, truth is kept beside."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager

import numpy as np

import scenes.builder
from twin import geometry
from twin.geometry import Array
from twin.imaging.camera import StereoCamera
from twin.imaging.light import Light
from twin.imaging.renderer import Renderer
from twin.judge.coverage import Coverage, true_heights
from twin.mission import Mission, Step
from twin.records import Frame, Trajectory, Truth
from twin.simulate.carrier import Carrier
from twin.simulate.sensors import NavigationSensors
from twin.simulate.vehicle import Vehicle, physics_timestep_s

#: Streams of randomness, in this order for ever: a draw of one never depends on another.
_STREAMS = ("left_eye", "right_eye", "navigation", "dvl", "usbl", "beacons", "snow")


class Sea:
    """The simulated world of a mission. Use as a context manager: it holds a GL context."""

    def __init__(self, mission: Mission, watch: Callable[[str], AbstractContextManager[None]]):
        scenario, rig = mission.scenario, mission.rig
        self.mission, self.watch = mission, watch
        vfov_deg = float(np.rad2deg(2 * np.arctan(rig.height_px / 2 / rig.focal_px)))
        world = scenes.builder.build(
            mission.terrain, rig.width_px, rig.height_px, vfov_deg, rig.baseline_m, rig.body_from_camera,
            physics_timestep_s(rig.frame_rate_hz), [lamp.position_m for lamp in scenario.lamps],
        )  # fmt: skip
        seeds = np.random.SeedSequence(scenario.seed).spawn(len(_STREAMS))
        rng = {name: np.random.default_rng(seed) for name, seed in zip(_STREAMS, seeds, strict=True)}
        body = mission.start @ geometry.inverse(rig.body_from_camera)
        self.vehicle = (
            Vehicle(world, scenario.vehicle, np.array(scenario.current.velocity_mps), body)
            if scenario.vehicle.dynamics == "rigid"
            else Carrier(body)
        )
        self.renderer = Renderer(world, rig.width_px, rig.height_px, vfov_deg)
        light = Light(scenario, mission.terrain, rng["snow"])
        self.camera = StereoCamera(self.renderer, light, scenario, rng["left_eye"], rng["right_eye"], watch)
        self.sensors = NavigationSensors(scenario.navigation, scenario.believed_noise(), rig, rng)
        self.coverage = Coverage(mission.grid, rig)
        self.true_poses: list[Array] = []
        self.steps: list[tuple[int, Step]] = []

    def __enter__(self) -> Sea:
        return self

    def __exit__(self, *_: object) -> None:
        self.renderer.close()

    @property
    def world_from_camera(self) -> Array:
        """(4, 4) true pose of the left camera."""
        return self.vehicle.world_from_body @ self.mission.rig.body_from_camera

    def observe(self, step: Step, track: int) -> Frame:
        """What the vehicle sees now; the truth of it is kept here."""
        index = len(self.true_poses)
        shot = self.camera.shoot(self.world_from_camera, step.key_point)
        self.true_poses.append(self.world_from_camera)
        self.steps.append((track, step))
        if shot.depth_right is not None:
            self.coverage.add(self.world_from_camera, shot.depth_left, shot.depth_right)
        time_s = index / self.mission.rig.frame_rate_hz
        depth_m = shot.depth_left if step.key_point else None
        readings = self.sensors.read(time_s, self.vehicle.world_from_body, self.vehicle.twist_body, depth_m)
        return Frame(index, time_s, shot.left, shot.right, readings)

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
            seen=self.coverage.seen,
        )
