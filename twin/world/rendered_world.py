"""The world of a survey as images show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

import scenes.builder
from twin.imaging.camera import StereoCamera
from twin.imaging.light import Light
from twin.imaging.renderer import Renderer
from twin.simulate.carrier import Carrier
from twin.simulate.hull import physics_timestep_s
from twin.simulate.sensors import NavigationSensors
from twin.simulate.vehicle import Vehicle
from twin.world.coverage import Coverage
from twin.world.mission import Mission, Step
from twin.world.world import CameraImages, Watch, World, streams


class RenderedWorld(World):
    """Rendered by MuJoCo and lit by the project's own optics; it holds a GL context."""

    def __init__(self, mission: Mission, watch: Watch):
        scenario, view = mission.scenario, mission.view
        rig, rng = view.rig, streams(scenario.seed)
        vfov_deg = float(np.rad2deg(2 * np.arctan(rig.height_px / 2 / rig.focal_px)))
        scene = scenes.builder.build(
            mission.terrain, rig.width_px, rig.height_px, vfov_deg, rig.baseline_m, rig.body_from_camera,
            physics_timestep_s(rig.frame_rate_hz), [lamp.position_m for lamp in scenario.lamps],
        )  # fmt: skip
        vehicle = (
            Vehicle(scene, scenario.vehicle, np.array(scenario.current.velocity_mps), mission.start_of_body)
            if scenario.vehicle.dynamics == "rigid"
            else Carrier(mission.start_of_body)
        )
        noise, believed = scenario.believed_noise(), mission.rig
        super().__init__(
            mission, watch, vehicle, NavigationSensors(scenario.navigation, noise, believed, rng, view.project)
        )
        self.renderer = Renderer(scene, rig.width_px, rig.height_px, vfov_deg)
        light = Light(scenario, mission.terrain, rng["snow"], rig)
        self.camera = StereoCamera(self.renderer, light, scenario, rng["left_camera"], rng["right_camera"], watch, view)
        self.coverage = Coverage(mission.grid, replace(believed, baseline_m=rig.baseline_m))

    def close(self) -> None:
        self.renderer.close()

    def look(self, step: Step) -> CameraImages:
        shot = self.camera.shoot(self.world_from_camera, step.keyframe, self.vehicle.twist_body)
        if shot.depth_right is not None:
            self.coverage.add(self.world_from_camera, shot.depth_left, shot.depth_right)
        return CameraImages(shot.left, shot.right, lambda: shot.depth_left)

    def seen(self) -> NDArray[np.bool_]:
        return self.coverage.seen
