"""Calibration of the surrogate: rendered surveys are flown beside a witness, and the model is fitted to its notes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

from twin import survey
from twin.config import Scenario
from twin.errors import SurveyAborted, TwinError
from twin.mission import Mission, prepare
from twin.rendered_sea import RenderedSea
from twin.results import make_map
from twin.surrogate.calibration import Calibration
from twin.surrogate.fit import Notes, fitted, misfit
from twin.surrogate.model import ErrorModel
from twin.surrogate.sea import vision_beside
from twin.surrogate.witness import Witness
from twin.timing import Stopwatch

_NOTES = "witness.json"
_LEAST_SURVEYS = 2


def fit_to(notes: Sequence[Notes], model: ErrorModel) -> Calibration:
    """The calibration of `model`, refined by what was noted beside it.

    Raises:
        TwinError: too few surveys got as far as a map.
    """
    whole = [n for n in notes if "chain_images" in n and "map_level_images" in n]
    if len(whole) < _LEAST_SURVEYS:
        raise TwinError("calibrate", f"{len(whole)} surveys were flown to their end", f"at least {_LEAST_SURVEYS}")
    found = fitted(whole, model)
    return Calibration(found, len(whole), misfit(whole, model, found))


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
    with RenderedSea(mission, watch) as sea:
        witness = _witness(mission, sea, folder, model)
        navigator = survey.make_navigator(mission, witness, watch)
        try:
            survey.fly(mission, sea, navigator, lambda *_: None)
            result = navigator.finish()
            make_map(mission, navigator, result, lambda _: None)
        except SurveyAborted:
            pass
    text = json.dumps({"scenario_hash": scenario.fingerprint(), "model": repr(model), "notes": witness.notes})
    (folder / _NOTES).write_text(text, encoding="utf-8")
    return witness.notes


def _witness(mission: Mission, sea: RenderedSea, folder: Path, model: ErrorModel) -> Witness:
    def truth():
        return sea.world_from_camera

    surrogate = vision_beside(mission, model, truth, Stopwatch())
    return Witness(survey.image_vision(mission, folder, sea.watch), surrogate, truth)
