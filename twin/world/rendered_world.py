"""Simulated world with rendered images."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array, Image, MapGrid
from twin.core.timing import StageTimer
from twin.imaging.image_formation import ImageFormation
from twin.imaging.scene.renderer import Renderer
from twin.imaging.stereo_camera import StereoCamera
from twin.scenes.builder import build
from twin.simulate.hull import physics_timestep_s
from twin.simulate.kinematic_vehicle import KinematicVehicle
from twin.simulate.mujoco_vehicle import MujocoVehicle
from twin.simulate.sea import make_sea
from twin.simulate.sensors import InertialSensor, NavigationSensors
from twin.simulate.tether import tether_of
from twin.terrains import Terrain
from twin.world.mesh_floor import floor_surface
from twin.world.mission import Mission, Step, motion_rate_hz
from twin.world.observed_cells import Coverage
from twin.world.obstacles import Obstacles
from twin.world.top_surface import TopSurface, top_surface, true_heights, with_objects
from twin.world.world import CameraImages, World, streams


class RenderedWorld(World):
    """World with images of the floor and objects, in the light of lamps and daylight, through water."""

    def __init__(self, mission: Mission, stopwatch: StageTimer):
        scenario, cameras = mission.scenario, mission.true_cameras
        rig, rng = cameras.rendered_rig, streams(scenario.seed)
        timestep_s = physics_timestep_s(rig.frame_rate_hz, scenario.vehicle)
        self._model = build(timestep_s, scenario.vehicle.mass_kg, scenario.vehicle.inertia_kgm2)
        vehicle: KinematicVehicle | MujocoVehicle = KinematicVehicle(mission.start_of_body)
        if scenario.vehicle.dynamics == "rigid":
            sea, tether = make_sea(scenario, rng["sea"]), tether_of(scenario.tether, mission.start_of_body[:3, 3])
            start = mission.start_of_body, tether, mission.start_velocity_mps
            vehicle = MujocoVehicle(self._model, scenario.vehicle, sea, *start)
        self._obstacles = Obstacles(mission)
        vehicle.touched = self._obstacles.touched
        noise, believed = scenario.believed_noise(), mission.rig
        imu = None
        if scenario.imu is not None:
            imu = InertialSensor(scenario.imu, motion_rate_hz(scenario), vehicle.inertial, rng["imu"])
            vehicle.after_timestep = imu.add
        sensors = NavigationSensors(scenario.navigation, noise, believed, rng, cameras.project, imu)
        super().__init__(mission, stopwatch, vehicle, sensors)
        floor, objects = mission.rendered_terrain, mission.rendered_objects()
        self.renderer = Renderer(floor, rig.width_px, rig.height_px, rig.focal_px, _seen_floor(mission))
        self._image_formation = ImageFormation(scenario, mission.illumination, floor, rng["snow"], rig, objects)
        noise_rngs = rng["left_camera"], rng["right_camera"]
        self.camera = StereoCamera(self.renderer, self._image_formation, scenario, *noise_rngs, stopwatch, cameras)
        self._surface = _overhanging_surface(mission, mission.grid)
        top_m = None if self._surface is None else self._surface.height_m
        self.coverage = Coverage(mission.grid, replace(believed, baseline_m=rig.baseline_m), top_m)

    def __exit__(self, *_: object) -> None:
        """Frees the floor of the renderer, a large part of the memory."""
        self.renderer.close()

    @property
    def made_anew(self) -> tuple[object, ...]:
        rendering = self.renderer, self._model, self._image_formation, self.camera.psf
        return (*super().made_anew, *rendering, self._obstacles, self._surface)

    def true_floor(self) -> Terrain:
        floor, objects = self.mission.terrain, self.mission.objects
        return with_objects(floor, objects) if objects else floor

    def capture(self, step: Step) -> CameraImages:
        if self.faults.exist:
            self._image_formation.light_lamps(self.faults.lamps_lit(len(self.mission.scenario.lamps)).tolist())
        images = self.camera.capture(self.world_from_camera, step.keyframe, self.vehicle.twist_body)
        if images.depth_right is not None:
            self.coverage.add(self.world_from_camera, images.depth_left, images.depth_right)
        return CameraImages(images.left, images.right, lambda: images.depth_left, images.exposure)

    def extra_pair(self) -> tuple[Image, Image]:
        return self.camera.capture_apart(self.world_from_camera, self.vehicle.twist_body)

    def right_image(self) -> Image:
        return self.camera.right_apart(self.world_from_camera, self.vehicle.twist_body)

    def true_surface(self) -> TopSurface:
        return super().true_surface() if self._surface is None else self._surface

    def surface_on(self, grid: MapGrid) -> TopSurface:
        return _overhanging_surface(self.mission, grid) or super().surface_on(grid)

    def seen(self) -> NDArray[np.bool_]:
        return self.coverage.seen


def _seen_floor(mission: Mission) -> tuple[Array, Array]:
    """Returns two corners (x, y) [m] between which all images lie if the vehicle stays near its path."""
    (x, y), margin_m = mission.grid.centres(), 1.0 + max(mission.plan.request.footprint_m) / 2
    return np.array([x[0], y[-1]]) - margin_m, np.array([x[-1], y[0]]) + margin_m


def _overhanging_surface(mission: Mission, grid: MapGrid) -> TopSurface | None:
    whole = mission.mesh_floor
    if whole is None and not mission.objects:
        return None
    bare = TopSurface(true_heights(grid, mission.terrain.height_at)) if whole is None else floor_surface(whole, grid)
    return top_surface(grid, bare, mission.objects)
