"""A survey that has been flown in the simulated world: its maps, findings, evaluation and record."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from twin.core.quality import ActionTimes, Finding
from twin.core.records import ElevationMap, SurveyResult, Truth
from twin.judge.metrics import EvaluationInput
from twin.plugin.navigator import NOTE
from twin.report.run_writer import PlannedTruth, SurveyRecord
from twin.scenario.idealisations import idealisations
from twin.scenario.model import Scenario
from twin.session.conclusion import Estimation, Maps
from twin.session.survey_check import calibration_notes, survey_findings
from twin.session.survey_orthomosaic import is_wanted, make_orthomosaic
from twin.world.floor_forecast import planned_overlap
from twin.world.mission import Mission


@dataclass(frozen=True)
class FlownSurvey:
    """A survey that has been flown: a `twin.session.conclusion.RunKind`."""

    mission: Mission  #: the survey as planned
    truth: Truth
    world_warnings: Sequence[str]  #: sentences on limits of the simulation
    actions: ActionTimes  #: durations for which the mission slowed and stopped the vehicle

    def maps(self, estimation: Estimation, result: SurveyResult) -> Maps:
        """Builds the elevation map and, if it is wanted, the orthomosaic."""
        with estimation.stopwatch("map"):
            elevation = estimation.build_map(result, self.mission.grid)
        if elevation is None or not is_wanted(self.mission, estimation.folder):
            return Maps(elevation)
        guard = estimation.guard

        def without_file_errors() -> Maps | None:
            try:
                return make_orthomosaic(self.mission, self.truth, estimation, result, elevation)
            except OSError as error:
                guard.cause = guard.cause or str(error)
                return None

        return guard.attempt("orthomosaic", without_file_errors) or Maps(elevation)

    def findings(self, result: SurveyResult, elevation: ElevationMap | None) -> list[Finding]:
        """Returns the failed checks of the estimates, the path and the mapped area."""
        return survey_findings(self.mission, result, elevation, self.truth.reference)

    def evaluation(self, result: SurveyResult, maps: Maps) -> EvaluationInput:
        """Returns the input of the evaluation."""
        mission, scenario, actions = self.mission, self.mission.scenario, self.actions
        along, across = planned_overlap(mission)
        plan = scenario.plan.model_dump(include={"pattern", "overlap_along", "overlap_across"})
        warnings = [
            *plugin_notes(scenario), *mission.terrain.hole_notes, *self.world_warnings,
            *calibration_notes(result, mission.rig), *result.quality.repeat_notes, *filter(None, [actions.sentence]),
        ]  # fmt: skip
        return EvaluationInput(
            result,
            maps.elevation,
            self.truth,
            mission.rig,
            plan=plan | {"along_median": along, "across_median": across},
            timing={"simulated_s": len(result.online) / mission.rig.frame_rate_hz},
            identity={"name": scenario.name, "seed": scenario.seed, "scenario_hash": scenario.fingerprint()},
            require=scenario.require,
            warnings=warnings,
            idealisations=idealisations(scenario),
            actions=actions,
        )

    def record(self, survey: EvaluationInput, written: SurveyRecord) -> SurveyRecord:
        """Returns the contents of the run folder, with the truth and the plan."""
        mission = self.mission
        return replace(
            written,
            simulated=PlannedTruth(self.truth, mission.grid, mission.start),
            n_frames_per_keyframe=mission.plan.n_frames_per_keyframe,
            georeference=mission.terrain.georeference,
            has_orthomosaic=survey.orthomosaic is not None,
        )


def plugin_notes(scenario: Scenario) -> list[str]:
    """Returns one note on each plug-in of the survey."""
    notes = (
        (scenario.terrain.plugin, "The heights of the floor are those of the plug-in {}."),
        (scenario.control.plugin, "The vehicle was steered by the plug-in {}."),
        (scenario.estimate.plugin, NOTE),
    )
    return [note.format(name) for name, note in notes if name is not None]
