"""Simulated world without images, objects and overhangs; vehicle and sensors are modelled as in `RenderedWorld`."""

from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.height_field import HeightField, cast_pixels
from twin.core.records import StereoRig
from twin.core.timing import StageTimer
from twin.estimate.pipeline import Navigator
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.hull import physics_timestep_s
from twin.simulate.kinematic_vehicle import KinematicVehicle
from twin.simulate.sea import make_sea
from twin.simulate.sensors import NavigationSensors
from twin.simulate.tether import tether_of
from twin.surrogate.compiled_loop import compiled_loop
from twin.surrogate.coverage import RENDERED, survey_conditions, unmodelled
from twin.surrogate.error_model_file import FittedErrorModel
from twin.surrogate.matchability import Matchability
from twin.surrogate.vision import SurrogateVision
from twin.world.mission import Mission, Step
from twin.world.obstacles import Obstacles, floor_of
from twin.world.pilot import PilotOfEstimates, RovPilot
from twin.world.world import CameraImages, FastForward, World, left_camera, streams

_BLANK: NDArray[np.uint8] = np.zeros((0, 0, 3), np.uint8)  # placeholder: an image without pixels


class SurrogateWorld(World):
    """World whose visual measurements are sampled from an error model.

    Raises UnmodelledError outside the range of the fit without `imaging.extrapolate`, or if marine snow prevents all
    matches.
    """

    def __init__(self, mission: Mission, stopwatch: StageTimer, fitted: FittedErrorModel):
        scenario, rig, rng = mission.scenario, mission.rig, streams(mission.scenario.seed)
        if scenario.vehicle.dynamics == "rigid":
            vehicle = CompiledVehicle(
                scenario.vehicle, make_sea(scenario, rng["sea"]), mission.start_of_body,
                physics_timestep_s(rig.frame_rate_hz, scenario.vehicle), floor_of(mission),
                tether_of(scenario.tether, mission.start_of_body[:3, 3]), mission.start_velocity_mps,
            )  # fmt: skip
        else:
            vehicle = KinematicVehicle(mission.start_of_body)
            self._obstacles = Obstacles(replace(mission, objects=()))
            vehicle.touched = self._obstacles.touched
        noise, project = scenario.believed_noise(), mission.true_cameras.project
        sensors = NavigationSensors(scenario.navigation, noise, rig, rng, project)
        super().__init__(mission, stopwatch, vehicle, sensors)
        # `vision` must not hold a reference to `self`: the reference cycle would keep the survey in memory
        true_pose = partial(left_camera, vehicle, rig)
        self.vision = SurrogateVision(mission, fitted.model, true_pose, stopwatch)
        self.warnings = _extrapolations(mission, fitted, self.vision.matchability)
        if mission.objects:
            self.warnings += ("The surrogate surveys the bare sea floor: it does not simulate [[objects]].",)
        if mission.mesh_floor is not None:
            self.warnings += ("The surrogate surveys the highest surface of the mesh: it simulates no overhangs.",)

    @property
    def made_anew(self) -> tuple[object, ...]:
        floor = self.vehicle.state.floor if isinstance(self.vehicle, CompiledVehicle) else self._obstacles
        return (*super().made_anew, floor, self.vision.floor, self.vision.matchability)

    def capture(self, step: Step) -> CameraImages:
        pose, rig = self.world_from_camera, self.mission.rig
        return CameraImages(
            _BLANK, _BLANK if step.keyframe else None, lambda: _depth_image(self.vision.floor, pose, rig)
        )

    def fast_forward(self, navigator: Navigator, pilot: PilotOfEstimates) -> FastForward:
        own = navigator.vision is self.vision
        if own and not self.faults.exist and isinstance(self.vehicle, CompiledVehicle) and isinstance(pilot, RovPilot):
            return compiled_loop(self, self.vehicle, self.vision, navigator, pilot)
        return super().fast_forward(navigator, pilot)

    def seen(self) -> NDArray[np.bool_]:
        return self.vision.map_model.seen


def _depth_image(floor: HeightField, world_from_camera: Array, rig: StereoRig) -> NDArray[np.float32]:
    """Returns the depth image (height_px, width_px) along the optical axis [m]; inf where rays miss the floor."""
    rows, cols = np.indices((rig.height_px, rig.width_px), dtype=np.float64)
    depth = cast_pixels(floor, world_from_camera[None], rig, np.column_stack([cols.ravel(), rows.ravel()]))
    return depth.reshape(rows.shape).astype(np.float32)


def _extrapolations(mission: Mission, fitted: FittedErrorModel, matchability: Matchability) -> tuple[str, ...]:
    """Returns a warning if the survey lies outside the range of the fit; see `SurrogateWorld`."""
    found = fitted.quantities_outside_fit(survey_conditions(mission, matchability))
    if found and not mission.scenario.imaging.extrapolate:
        problem = "the error model of the surrogate does not hold for this survey"
        texts = ((f"{problem}: {values}", f"{allowed}, or {RENDERED}, or --extrapolate") for values, allowed in found)
        raise unmodelled(mission, texts)
    texts = "; ".join(f"{values} ({allowed})" for values, allowed in found)
    return (f"The surrogate extrapolates outside the range of its error model: {texts}.",) if found else ()
