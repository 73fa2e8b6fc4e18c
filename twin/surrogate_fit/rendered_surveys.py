"""Fit of the surrogate: rendered surveys are flown beside a witness, and the model is fitted to its notes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from twin import survey
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted, TwinError
from twin.scenario.model import Scenario
from twin.session.conclusion import make_map
from twin.surrogate.error_model import ErrorModel
from twin.surrogate.error_model_file import FittedErrorModel
from twin.surrogate.surrogate_world import vision_beside
from twin.surrogate_fit.fit import Notes, fitted, misfit
from twin.surrogate_fit.witness import Witness
from twin.world.mission import Mission, prepare
from twin.world.rendered_world import RenderedWorld

_NOTES = "witness.json"
_LEAST_SURVEYS = 2


def fit_to(notes: Sequence[Notes], model: ErrorModel) -> FittedErrorModel:
    """The calibration of `model`, refined by what was noted beside it.

    Raises:
        TwinError: too few surveys got as far as a map.
    """
    whole = [n for n in notes if "chain_images" in n and "map_level_images" in n]
    if len(whole) < _LEAST_SURVEYS:
        raise TwinError("calibrate", f"{len(whole)} surveys were flown to their end", f"at least {_LEAST_SURVEYS}")
    found = fitted(whole, model)
    return FittedErrorModel(found, len(whole), misfit(whole, model, found))


def note(scenario: Scenario, folder: Path, model: ErrorModel) -> Notes:
    """What a witness notes on a rendered survey; taken from the folder where the same was flown beside this model."""
    return _taken(scenario, folder, model) or _fly(scenario, folder, model)


def _taken(scenario: Scenario, folder: Path, model: ErrorModel) -> Notes | None:
    """The notes of the same survey flown before."""
    try:
        kept = json.loads((folder / _NOTES).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    same = kept["scenario_hash"] == scenario.fingerprint() and kept["model"] == repr(model)
    return kept["notes"] if same else None


def _fly(scenario: Scenario, folder: Path, model: ErrorModel) -> Notes:
    """A rendered survey with a witness; an aborted one tells what it saw so far."""
    mission, watch = prepare(scenario), Stopwatch()
    folder.mkdir(parents=True, exist_ok=True)
    with RenderedWorld(mission, watch) as world:
        witness = _witness(mission, world, folder, model)
        navigator = survey.make_navigator(mission, witness, watch)
        try:
            survey.fly(mission, world, navigator, lambda *_: None)
            result = navigator.finish()
            make_map(mission, navigator, result, lambda _: None)
        except SurveyAborted:
            pass
    text = json.dumps({"scenario_hash": scenario.fingerprint(), "model": repr(model), "notes": witness.notes})
    (folder / _NOTES).write_text(text, encoding="utf-8")
    return witness.notes


def _witness(mission: Mission, world: RenderedWorld, folder: Path, model: ErrorModel) -> Witness:
    def truth():
        return world.world_from_camera

    surrogate = vision_beside(mission, model, truth, Stopwatch())
    return Witness(survey.image_vision(mission, folder, world.watch), surrogate, truth)
