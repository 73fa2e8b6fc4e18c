"""Simulated world without images; vehicle and navigation sensors are modelled as in `RenderedWorld`.

The floor has neither objects nor overhangs.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.height_field import HeightField, cast_pixels, height_field
from twin.core.records import StereoRig
from twin.core.timing import StageTimer
from twin.errors import TwinError, UnmodelledError
from twin.estimate.pipeline import Navigator
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.hull import physics_timestep_s
from twin.simulate.kinematic_vehicle import KinematicVehicle
from twin.simulate.sensors import NavigationSensors
from twin.surrogate.compiled_loop import compiled_loop
from twin.surrogate.coverage import QuantityOutsideFit, survey_conditions
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.error_model_file import FittedErrorModel
from twin.surrogate.map_model import MapModel
from twin.surrogate.matchability import Matchability
from twin.surrogate.measured_view import measured_view
from twin.surrogate.vision import SurrogateVision, TrueScene
from twin.world.mission import Mission, Step
from twin.world.obstacles import Obstacles, floor_of
from twin.world.pilot import PilotOfEstimates, RovPilot
from twin.world.top_surface import true_heights
from twin.world.world import CameraImages, FastForward, World, left_camera, streams

_BLANK: NDArray[np.uint8] = np.zeros((0, 0, 3), np.uint8)  # placeholder: an image without pixels


class SurrogateWorld(World):
    """World whose visual measurements are sampled from an error model.

    Raises:
        UnmodelledError: the survey lies outside the range of the fit, and `imaging.extrapolate` is not set; or marine
            snow prevents all matches at `Matchability.medium_depth_m`.
    """

    def __init__(self, mission: Mission, stopwatch: StageTimer, fitted: FittedErrorModel):
        scenario, rig, rng = mission.scenario, mission.rig, streams(mission.scenario.seed)
        vehicle = (
            CompiledVehicle(
                scenario.vehicle, np.array(scenario.current.velocity_mps), mission.start_of_body,
                physics_timestep_s(rig.frame_rate_hz), floor_of(mission),
            )
            if scenario.vehicle.dynamics == "rigid"
            else KinematicVehicle(mission.start_of_body)
        )  # fmt: skip
        if isinstance(vehicle, KinematicVehicle):
            vehicle.touched = Obstacles(replace(mission, objects=())).touched
        super().__init__(
            mission,
            stopwatch,
            vehicle,
            NavigationSensors(scenario.navigation, scenario.believed_noise(), rig, rng, mission.true_cameras.project),
        )
        # `vision` must not hold a reference to `self`: the reference cycle would keep the survey in memory
        true_pose = partial(left_camera, vehicle, rig)
        self.vision = surrogate_vision(mission, fitted.model, true_pose, stopwatch)
        self.warnings = _extrapolations(mission, fitted, self.vision.scene.matchability)
        if mission.objects:
            self.warnings += ("The surrogate surveys the bare sea floor: it does not simulate [[objects]].",)
        if mission.mesh_floor is not None:
            self.warnings += ("The surrogate surveys the highest surface of the mesh: it simulates no overhangs.",)

    def close(self) -> None:
        """Does nothing."""

    def capture(self, step: Step) -> CameraImages:
        pose, rig = self.world_from_camera, self.mission.rig
        return CameraImages(
            _BLANK, _BLANK if step.keyframe else None, lambda: _depth_image(self.vision.scene.floor, pose, rig)
        )

    def fast_forward(self, navigator: Navigator, pilot: PilotOfEstimates) -> FastForward:
        if (
            isinstance(self.vehicle, CompiledVehicle)
            and isinstance(pilot, RovPilot)
            and navigator.vision is self.vision
        ):
            return compiled_loop(self, self.vehicle, self.vision, navigator, pilot)
        return super().fast_forward(navigator, pilot)

    def seen(self) -> NDArray[np.bool_]:
        return self.vision.scene.map_model.seen


def _depth_image(floor: HeightField, world_from_camera: Array, rig: StereoRig) -> NDArray[np.float32]:
    """Returns the depth image (height_px, width_px) along the optical axis [m]; inf where rays miss the floor."""
    rows, cols = np.indices((rig.height_px, rig.width_px), dtype=np.float64)
    depth = cast_pixels(floor, world_from_camera[None], rig, np.column_stack([cols.ravel(), rows.ravel()]))
    return depth.reshape(rows.shape).astype(np.float32)


def _extrapolations(mission: Mission, fitted: FittedErrorModel, matchability: Matchability) -> tuple[str, ...]:
    """Returns a warning if the survey lies outside the range of the fit; see `SurrogateWorld`."""
    found = fitted.quantities_outside_fit(survey_conditions(mission, matchability))
    if not found:
        return ()
    if not mission.scenario.imaging.extrapolate:
        source = mission.scenario.source
        raise UnmodelledError([source.describe(_refusal(quantity)) for quantity in found])
    texts = [f"{one.value_text} ({one.allowed_text})" for one in found]
    return (f"The surrogate extrapolates outside the range of its error model: {'; '.join(texts)}.",)


def _refusal(quantity: QuantityOutsideFit) -> TwinError:
    """Returns the error of a survey outside the range of the fit."""
    return TwinError(
        "imaging.fidelity",
        f"the error model of the surrogate does not hold for this survey: {quantity.value_text}",
        f'{quantity.allowed_text}, or imaging.fidelity = "rendered", or --extrapolate',
    )


def _check_matches(mission: Mission, matchability: Matchability) -> None:
    """Raises UnmodelledError if marine snow prevents all matches at `Matchability.medium_depth_m`."""
    if math.isfinite(matchability.medium_bound_px):
        return
    error = TwinError(
        "imaging.fidelity",
        f"the surrogate cannot simulate this survey: marine snow prevents all matches of the floor at a depth of "
        f"{matchability.medium_depth_m:.3g} m",
        'less [snow], or imaging.fidelity = "rendered"',
    )
    raise UnmodelledError([mission.scenario.source.describe(error)])


def surrogate_vision(
    mission: Mission, model: ErrorModel, true_pose: Callable[[], Array], stopwatch: StageTimer
) -> SurrogateVision:
    """Returns the `SurrogateVision` of a mission.

    Args:
        true_pose: function that returns the current true world_from_camera (4, 4) of the left camera.

    Raises:
        UnmodelledError: marine snow prevents all matches at `Matchability.medium_depth_m`.
    """
    scenario, terrain = mission.scenario, mission.terrain
    matchability = Matchability(scenario, mission.illumination, terrain, mission.plan.area.at_fractions)
    _check_matches(mission, matchability)
    view = measured_view(mission.true_cameras, mission.rig, matchability.depths_m)
    floor = height_field(terrain.height_m, terrain.spacing_m, terrain.west_m, terrain.south_m)
    heights = true_heights(mission.grid, terrain.height_at)
    rig = mission.rig.binned(matchability.binning)
    map_model = MapModel(mission.grid, heights, rig, floor, matchability, view)
    scene = TrueScene(true_pose, floor, matchability, map_model, view)
    rng = streams(scenario.seed)["surrogate"]
    return SurrogateVision(rig, scenario.estimator_settings(), model, scene, rng, stopwatch)
