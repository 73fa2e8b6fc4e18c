"""A survey that has been flown in the simulated world: its maps, findings, evaluation and record."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from twin.core.ortho_tiles import at_centres, mean_colours, window
from twin.core.quality import ActionTimes, Finding, Gaps
from twin.core.records import ElevationMap, SurveyResult, Truth
from twin.judge.metrics import EvaluationInput, SurveyedTask
from twin.judge.orthomosaic_errors import OrthomosaicJudge
from twin.plugin.navigator import NOTE
from twin.report.run_writer import PlannedTruth, SurveyRecord
from twin.scenario.idealisations import idealisations
from twin.scenario.model import Scenario
from twin.session.conclusion import Estimation, Maps
from twin.session.survey_check import calibration_notes, survey_findings, with_altimeter_scale
from twin.world.energy import flown_energy
from twin.world.floor_forecast import planned_overlap
from twin.world.mission import Detail, Mission


@dataclass(frozen=True)
class FlownSurvey:
    """A survey that has been flown: a `twin.session.conclusion.RunKind`."""

    mission: Mission  #: the survey as planned
    truth: Truth
    world_warnings: Sequence[str]  #: sentences on limits of the simulation
    actions: ActionTimes  #: durations for which the mission slowed and stopped the vehicle
    gaps: Gaps = Gaps()
    #: returns the truth at the cells of the map of a task, from that of the survey and the rows of its keyframes
    detail_truth: Callable[[Detail, Truth, NDArray[np.int64]], Truth] | None = None

    def maps(self, estimation: Estimation, result: SurveyResult) -> Maps:
        """Builds the elevation map and, if maps are written or it is judged, the orthomosaic of the scenario."""
        tracks, track_of = [detail.track for detail in self.mission.details], result.track_of_keyframe
        chosen = ~np.isin(track_of, tracks) if tracks else None  # keyframes of the area, not of tasks; None: all
        with estimation.stopwatch("map"):
            elevation = estimation.build_map(result, self.mission.grid, chosen)
            details = tuple(estimation.build_map(result, d.grid, track_of == d.track) for d in self.mission.details)
        maps = self._with_orthomosaic(estimation, result, elevation, chosen)._replace(details=details)
        self.mission.terrain.free_texture()
        return maps

    def _with_orthomosaic(
        self, estimation: Estimation, result: SurveyResult, elevation: ElevationMap | None,
        chosen: NDArray[np.bool_] | None,
    ) -> Maps:  # fmt: skip
        scenario = self.mission.scenario
        required = any(name.startswith("orthomosaic.") for name in scenario.require)
        if elevation is None or not (scenario.map.orthomosaic and (estimation.folder.writes_maps or required)):
            return Maps(elevation)
        guard = estimation.guard

        def without_file_errors() -> Maps | None:
            try:
                return make_orthomosaic(self.mission, self.truth, estimation, result, elevation, chosen)
            except OSError as error:
                guard.cause = guard.cause or str(error)
                return None

        return guard.attempt("orthomosaic", without_file_errors) or Maps(elevation)

    def findings(self, result: SurveyResult, elevation: ElevationMap | None) -> list[Finding]:
        result = with_altimeter_scale(self.mission, result, elevation)
        return survey_findings(self.mission, result, elevation, self.truth.reference)

    def evaluation(self, result: SurveyResult, maps: Maps) -> EvaluationInput:
        mission, scenario, actions = self.mission, self.mission.scenario, self.actions
        result = with_altimeter_scale(mission, result, maps.elevation)
        along, across = planned_overlap(mission)
        plan = scenario.plan.model_dump(include={"pattern", "overlap_along", "overlap_across"})
        plan |= {"both_ways": mission.plan.follows_floor} | mission.plan.swath_notes
        warnings = [
            *plugin_notes(scenario), *mission.hole_notes, *self.world_warnings,
            *calibration_notes(result, mission.rig), *result.quality.repeat_notes, *result.quality.reading_notes,
            *filter(None, [actions.sentence, self.gaps.sentence]),
        ]  # fmt: skip
        return EvaluationInput(
            result, maps.elevation, self.truth, mission.rig,
            plan=plan | {"along_median": along, "across_median": across},
            timing={"simulated_s": len(result.online) / mission.rig.frame_rate_hz},
            identity={"name": scenario.name, "seed": scenario.seed, "scenario_hash": scenario.fingerprint()},
            require=scenario.require, warnings=warnings, idealisations=idealisations(scenario),
            water=mission.clarity._asdict(), stated_input=mission.stated_input, actions=actions, gaps=self.gaps,
            energy=flown_energy(mission, self.truth.trajectory), tasks=self._tasks(result, maps),
        )  # fmt: skip

    def _tasks(self, result: SurveyResult, maps: Maps) -> list[SurveyedTask]:
        if self.detail_truth is None:
            return []
        found, (x, y) = list[SurveyedTask](), np.meshgrid(*self.mission.grid.centres())
        for detail, elevation in zip(self.mission.details, maps.details, strict=True):
            rows = result.keyframe_rows[result.track_of_keyframe == detail.track]
            truth = self.detail_truth(detail, self.truth, rows[rows < len(self.truth.trajectory)])
            found.append(SurveyedTask(detail.name, detail.track, elevation, truth, detail.area.contains(x, y)))
        return found

    def record(self, survey: EvaluationInput, written: SurveyRecord) -> SurveyRecord:
        mission = self.mission
        return replace(
            written, simulated=PlannedTruth(self.truth, mission.grid, mission.start),
            n_frames_per_keyframe=mission.plan.n_frames_per_keyframe, georeference=mission.terrain.georeference,
            has_orthomosaic=survey.orthomosaic is not None, tasks=survey.tasks,
        )  # fmt: skip


def plugin_notes(scenario: Scenario) -> list[str]:
    notes = (
        (scenario.terrain.plugin, "The heights of the floor are those of the plug-in {}."),
        (scenario.control.plugin, "The vehicle was steered by the plug-in {}."),
        (scenario.estimate.plugin, NOTE),
    )
    return [note.format(name) for name, note in notes if name is not None]


def make_orthomosaic(
    mission: Mission, truth: Truth, estimation: Estimation, result: SurveyResult, elevation: ElevationMap,
    chosen: NDArray[np.bool_] | None = None,
) -> Maps | None:  # fmt: skip
    """Makes the orthomosaic of a survey, writes it if the run folder keeps maps, and compares it with the truth.

    The lamps and the water of the scenario serve the restoration of colours, the true albedo the comparison only.
    Returns the elevation map with the colours averaged to its cells; None without images or mapped cells. Raises
    OSError if a file cannot be read or written.
    """
    stopwatch, folder, restored = estimation.stopwatch, estimation.folder, mission.scenario.map.restore
    if not np.isfinite(elevation.height_m).any():
        return None
    with stopwatch("orthomosaic"):
        restore = None
        if restored:
            from twin.imaging.restoration import Restoration  # imported here: others do not need its tables

            restore = Restoration(mission.scenario, mission.illumination, mission.rig, elevation)
        report = partial(estimation.progress, "orthomosaic")
        tiles = estimation.navigator.orthomosaic(result, elevation, restore, report, chosen) or iter(())
        first = tile = next(tiles, None)
    if first is None:
        return None
    judge, mosaic = OrthomosaicJudge(restored), np.zeros_like(elevation.mosaic)
    n = round(elevation.grid.cell_m / first.grid.cell_m)
    with folder.orthomosaic_file(first.grid, mission.terrain.georeference) as file:
        while tile is not None:
            colours, row, col = mean_colours(tile, n), tile.row // n, tile.col // n
            mosaic[row : row + len(colours), col : col + colours.shape[1]] = colours
            if truth.albedo is not None and truth.in_area is not None:
                part = window(tile.grid, tile.row, tile.col, *tile.rgba.shape[:2])
                judge.add(tile, truth.albedo(part), at_centres(truth.in_area, part))
            with stopwatch("orthomosaic"):
                if file is not None:
                    file.write(tile)
                tile = next(tiles, None)
    return Maps(replace(elevation, mosaic=mosaic), judge.metrics())
