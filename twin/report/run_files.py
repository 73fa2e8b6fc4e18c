"""Validates the scenario and the JSON files of a run folder, which may have been edited since `twin run` wrote them."""

import math
from collections.abc import Mapping
from typing import Any

from twin.judge.map_error import KEYS as MAP_KEYS
from twin.judge.metrics import empty_metrics
from twin.scenario.model import Scenario

#: Key of a template that stands for every key of a table; its value is the template of each of the table's values.
_ANY = "*"
#: Template of a number that may be NaN, which Python's json reads and writes, or None.
_NAN = math.nan
_LARGEST = 1e15  # largest absolute value of a number
OBSERVATION_KEYS = ("row", "n_points", "contrast")
_TRACK = {"track": 0} | dict.fromkeys(
    ("before_ga_rmse_m", "after_ga_rmse_m", "farthest_error_m", "ga_ms", "nodes", "edges")
)
_TASK = {"name": "", "track": 0} | dict.fromkeys((*MAP_KEYS, "area_map_le90_m", "error_before_m", "error_after_m"))
#: Input statement of a floor that was read from files (`twin.terrains.terrain`).
_INPUT = {
    **dict.fromkeys(("file", "crs", "spacing_evidence", "unit_evidence", "direction", "direction_evidence"), ""),
    **dict.fromkeys(("spacing_m", "metres_per_unit", "least", "greatest", "share_without_height"), 0.0),
    **{"ground_scale": None, "nodata": "", "texture": "", "doubts": [""]},
}
_INDEX = {
    "frames": [0],
    "tracks": [0],
    "n_frames_per_keyframe": None,
    "timing_ms": {_ANY: [0.0]},
    "stereo_observations": [{name: _NAN for name in OBSERVATION_KEYS}],
    "map_from_world": [[0.0]],
    "position_cov_m2": [[[0.0]]],
    "link_residuals": [0.0],
    "asked_m2": None,
    "asked_area_m": [[[0.0]]],
}


def checked_metrics(metrics: Any) -> dict[str, Any]:
    """Returns valid metrics, None and [] for missing numbers and lists; raises ValueError, which names the key."""
    template = empty_metrics()
    texts = dict.fromkeys(("name", "status"), "")
    optional = dict.fromkeys(("version", "scenario_hash", "reason", "warning", "schema"), _OptionalText)
    sentences = {"warnings": [""], "idealisations": [""]}
    require = {_ANY: {"value": None, "limit": 0.0, "passed": False}}
    if isinstance(metrics, dict) and metrics.get("input"):
        template |= {"input": _INPUT}
    return conform(
        metrics,
        template | texts | optional | sentences | {"tracks": [_TRACK], "tasks": [_TASK], "require": require},
        complete=True,
    )


def checked_index(index: Any) -> dict[str, Any]:
    index = conform(index, _INDEX)
    for key in ("frames", "tracks"):
        if not all(isinstance(number, int) and number >= 0 for number in index.get(key, [])):
            raise ValueError(f"{key}: not allowed (allowed: integers from 0)")
    if len(index.get("frames", [])) != len(index.get("tracks", [])):
        raise ValueError("tracks: must have one number per frame")
    if "map_from_world" in index and [len(row) for row in index["map_from_world"]] != [4] * 4:
        raise ValueError("map_from_world: must have 4 rows of 4 numbers")
    if any([len(row) for row in cov] != [3, 3, 3] for cov in index.get("position_cov_m2", [])):
        raise ValueError("position_cov_m2: must have 3 rows of 3 numbers for each keyframe")
    if any(len(corner) != 2 for ring in index.get("asked_area_m", []) for corner in ring):
        raise ValueError("asked_area_m: must be rings of corners with 2 numbers")
    return index


def checked_scenario(scenario: Any) -> dict[str, Any]:
    template = Scenario().model_dump(mode="json", exclude_none=True)  # a key without a default may have any value
    return conform(scenario, template | {"lamps": [], "beacons": []})


class _OptionalText:
    """Template of a value that is a string or None."""


def conform(given: Any, template: Any, key: str = "", complete: bool = False) -> Any:
    """Returns a value after a check that it has the structure of a template; else ValueError, which names its `key`.

    A table has a value for each of its keys, or for any other under "*"; without "*", others are unchecked. The only
    item of a list, if any, is that of all items. A string, a Boolean or a finite number stand for their types,
    `_OptionalText` for a string or None, None for a finite number or None, NaN for a number, NaN or None. With
    `complete`, missing keys of tables (not of those in lists) are None or, for lists, []; a missing string is an error.
    """
    if isinstance(template, dict):
        _require(isinstance(given, dict), key, given, "a table")
        checked = dict(given)
        for name in template.keys() - given.keys() - {_ANY} if complete else ():
            _require(template[name] != "", _join(key, name), None, "a string: it is missing")
            checked[name] = _nothing(template[name])
        for name in given if _ANY in template else given.keys() & template.keys():
            checked[name] = conform(given[name], template.get(name, template.get(_ANY)), _join(key, name), complete)
        return checked
    if isinstance(template, list):
        _require(isinstance(given, list), key, given, "a list")
        return [_item(item, template[0], f"{key}.{k}") for k, item in enumerate(given)] if template else given
    allowed, fits = _scalar_rule(template, given)
    _require(fits, key, given, allowed)
    return given


def _item(given: Any, template: Any, key: str) -> Any:
    """Returns an item of a list, checked like `conform`; a table must have all keys of its template."""
    if isinstance(template, dict) and isinstance(given, dict):
        for name in template.keys() - given.keys():
            _require(False, f"{key}.{name}", None, "a value: it is missing")
    return conform(given, template, key)


def _nothing(template: Any) -> Any:
    """Returns the value for missing contents: [] for a list, a table of such values for a table, otherwise None."""
    if isinstance(template, dict):
        return {name: _nothing(value) for name, value in template.items() if name != _ANY}
    return [] if isinstance(template, list) else None


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


def _scalar_rule(template: Any, given: Any) -> tuple[str, bool]:
    """Returns a description of the single values that a template allows, and whether `given` is one of them."""
    is_number = isinstance(given, int | float) and not isinstance(given, bool)
    if isinstance(template, str):
        return "a string", isinstance(given, str)
    if template is _OptionalText:
        return "a string or null", given is None or isinstance(given, str)
    if isinstance(template, bool):
        return "true or false", isinstance(given, bool)
    if template is _NAN:
        return "a number", given is None or (is_number and not abs(given) > _LARGEST)
    fits = is_number and abs(given) <= _LARGEST
    if template is None:
        return f"null or a number up to {_LARGEST:g}", given is None or fits
    return f"a number up to {_LARGEST:g}", fits


def _require(fits: bool, key: str, given: Any, allowed: str) -> None:
    if not fits:
        shown = "a table" if isinstance(given, Mapping) else repr(given)[:80]
        raise ValueError(f"{key or 'contents'}: {shown} (allowed: {allowed})")
