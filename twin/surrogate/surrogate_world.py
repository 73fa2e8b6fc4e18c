"""The sea of a surrogate survey: the same vehicle and sensors over the same floor, with nothing rendered."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.estimate.pipeline import Navigator
from twin.simulate.carrier import Carrier
from twin.simulate.free_body import FreeBody
from twin.simulate.hull import physics_timestep_s
from twin.simulate.sensors import NavigationSensors
from twin.surrogate.compiled_loop import compiled
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.error_model_file import FittedErrorModel
from twin.surrogate.floor_rays import Floor
from twin.surrogate.map_model import Chart
from twin.surrogate.matchability import Conditions
from twin.surrogate.vision import SurrogateVision
from twin.world.coverage import true_heights
from twin.world.mission import Mission, Step
from twin.world.pilot import PilotOfEstimates, RovPilot
from twin.world.world import CameraImages, Glide, Watch, World, left_camera, streams

_BLANK: NDArray[np.uint8] = np.zeros((0, 0, 3), np.uint8)  # a camera without pixels


class SurrogateWorld(World):
    """Vision is asked for measurements instead of images: `vision` gives them."""

    def __init__(self, mission: Mission, watch: Watch, calibration: FittedErrorModel):
        scenario, rig, rng = mission.scenario, mission.rig, streams(mission.scenario.seed)
        vehicle = (
            FreeBody(
                scenario.vehicle, np.array(scenario.current.velocity_mps), mission.start_of_body,
                physics_timestep_s(rig.frame_rate_hz),
            )
            if scenario.vehicle.dynamics == "rigid"
            else Carrier(mission.start_of_body)
        )  # fmt: skip
        super().__init__(
            mission, watch, vehicle, NavigationSensors(scenario.navigation, scenario.believed_noise(), rig, rng)
        )
        # not of `self`, which holds the vision: a survey that is over gives its memory back at once
        self._told = vision_beside(mission, calibration.model, partial(left_camera, vehicle, rig), watch)
        self.vision = self._told
        outside = calibration.outside(*self._told.bounds_px)
        self.warnings = (f"surrogate: {outside}",) if outside else ()

    def close(self) -> None:
        pass

    def look(self, step: Step) -> CameraImages:
        pose, rig = self.world_from_camera, self.mission.rig
        return CameraImages(_BLANK, _BLANK if step.keyframe else None, lambda: self._told.floor.depth(pose, rig))

    def glide(self, navigator: Navigator, pilot: PilotOfEstimates) -> Glide | None:
        if isinstance(self.vehicle, FreeBody) and isinstance(pilot, RovPilot) and navigator.vision is self.vision:
            return compiled(self, self.vehicle, self._told, navigator, pilot)
        return None

    def seen(self) -> NDArray[np.bool_]:
        return self._told.chart.seen


def vision_beside(mission: Mission, model: ErrorModel, truth: Callable[[], Array], watch: Watch) -> SurrogateVision:
    """The surrogate's answers for a vehicle whose camera truly is where `truth` says, (4, 4)."""
    scenario, terrain = mission.scenario, mission.terrain
    chart = Chart(mission.grid, true_heights(mission.grid, terrain.height_at), mission.rig)
    conditions = Conditions(scenario, terrain)
    rng = streams(scenario.seed)["surrogate"]
    return SurrogateVision(mission.rig, scenario.estimate, model, truth, Floor(terrain), conditions, chart, rng, watch)
