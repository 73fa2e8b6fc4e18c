"""Writes the reference of the keys of scenarios, studies and metrics: `python docs/reference.py FOLDER`."""

import inspect
import json
import re
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

from twin.judge.consistency import consistency_metrics
from twin.judge.map_error import map_metrics
from twin.judge.metrics import empty_metrics
from twin.judge.network_errors import link_metrics, stage_metrics
from twin.judge.orthomosaic_errors import OrthomosaicJudge
from twin.judge.survey_quality import self_check_metrics, stereo_quality
from twin.judge.swaths import control_metrics, overlap_metrics
from twin.judge.trajectory_errors import track_metrics, trajectory_metrics
from twin.judge.verdict import MORE_IS_BETTER, SIGNED
from twin.report.number_formats import unit_of
from twin.scenario.model import Scenario
from twin.studies.study_file import Study

HEAD = """# {}

Written by `python docs/reference.py docs/reference` from the model of {}. {}

"""
SCENARIO_NOTE = (
    "`twin schema` prints the same as a JSON schema for editors. How the keys work together is in the\n"
    "[scenario guide](../guide/scenario.md)."
)
STUDY_NOTE = "What studies and tunings do with them is in\n[studies and tuning](../guide/studies.md)."
METRICS_HEAD = """# Metrics

Written by `python docs/reference.py docs/reference` from the functions in `twin/judge/` that compute `metrics.json`.
A value that cannot be computed is null. `[require]` of a scenario or study limits any of them: from above, or from
below where the table says "at least"; of one that can be negative, the absolute value. `status` is "complete",
"degraded" (a check of the estimators failed) or "aborted"; `reason` says why. The final path is after the alignment of
all keyframes, the online one what the vehicle knew on the way, f2f the motion from frame to frame alone.

"""
#: Functions that compute sections of metrics.json; their docstrings describe the keys.
_METRICS: dict[str, Callable[..., Any]] = {
    "trajectory": trajectory_metrics, "map": map_metrics, "orthomosaic": OrthomosaicJudge.metrics,
    "consistency": consistency_metrics, "self_check": self_check_metrics, "vision": stereo_quality,
    "links": link_metrics, "stages": stage_metrics, "tracks": track_metrics, "control": control_metrics,
    "overlap": overlap_metrics,
}  # fmt: skip
_TITLES = {"lamps": "[[lamps]]", "beacons": "[[beacons]]", "objects": "[[objects]]", "together": "[[together]]"}
_UNIT = re.compile(r"\s*(?<!with )(?<!needs )\[([^\[\],]+)\](?=$|;)")
_BOUNDS = {
    "minimum": ">= {}", "exclusiveMinimum": "> {}", "maximum": "<= {}", "exclusiveMaximum": "< {}",
}  # fmt: skip


def pages() -> dict[str, str]:
    """Returns the pages as Markdown, by the name of their file."""
    return {
        "scenario.md": HEAD.format("Scenario keys", "a scenario", SCENARIO_NOTE)
        + _tables(Scenario.model_json_schema()),
        "study.md": HEAD.format("Study keys", "a study", STUDY_NOTE)
        + _tables(Study.model_json_schema(), "Distribution"),
        "metrics.md": METRICS_HEAD + _metrics(),
    }


def _metrics() -> str:
    """Returns one table for each section of metrics.json, under the description by the function that computes it."""
    parts, empty = [], empty_metrics()
    for section, function in _METRICS.items():
        text = re.split(r"\n\s*(?:Args|Raises):", inspect.getdoc(function) or "")[0]
        rows = ["| key | unit | `[require]` |", "|---|---|---|"]
        for key in _leaves(section, empty[section]):
            limit = "at least" if key.startswith(MORE_IS_BETTER) else "at most" + " (absolute value)" * (key in SIGNED)
            rows.append(f"| `{key}` | {unit_of(key)} | {limit} |")
        table = "\n".join(rows) if len(rows) > 2 else "A list with one entry for each track."
        parts.append(f"## `{section}`\n\n{text.strip()}\n\n{table}\n")
    return "\n".join(parts)


def _leaves(name: str, value: Any) -> Iterator[str]:
    """Yields the dotted keys of the numbers under a key."""
    if isinstance(value, dict) and value:
        for key, part in value.items():
            yield from _leaves(f"{name}.{key}", part)
    elif not isinstance(value, list):
        yield name


def _tables(schema: dict[str, Any], *definitions: str) -> str:
    """Returns one table for the top level, one for each section, and one for each of the definitions."""
    sections = {name: found for name, key in schema["properties"].items() if (found := _section(schema, key))}
    top = {name: key for name, key in schema["properties"].items() if name not in sections}
    titled = {f"`{_TITLES.get(name, f'[{name}]')}`": section for name, section in sections.items()}
    titled |= {name: schema["$defs"][name] for name in definitions}
    parts = ["## Top level\n\n" + _table(top)]
    for title, section in titled.items():
        parts.append(f"## {title}\n\n{' '.join(section['description'].split())}\n\n{_table(section['properties'])}")
    return "\n".join(parts)


def _section(schema: dict[str, Any], key: dict[str, Any]) -> dict[str, Any] | None:
    """Returns the definition of a section to which a key of the scenario refers, directly, optionally or in a list."""
    for part in (key, key.get("items", {}), *key.get("anyOf", [])):
        if "$ref" in part:
            return schema["$defs"][part["$ref"].rpartition("/")[2]]
    return None


def _table(keys: dict[str, Any]) -> str:
    rows = ["| key | default | unit | allowed | description |", "|---|---|---|---|---|"]
    for name, key in keys.items():
        allowed, text = _allowed(key), key["description"].replace("|", "\\|")
        unit = None if allowed == "text" else _UNIT.search(text)
        text = _UNIT.sub("", text) if unit else text
        default = f"`{json.dumps(key['default'])}`" if key.get("default") is not None else ""
        rows.append(f"| `{name}` | {default} | {unit[1] if unit else ''} | {allowed} | {text} |")
    return "\n".join(rows) + "\n"


def _allowed(key: dict[str, Any]) -> str:
    """Returns the type of a key, or its values, with its range."""
    if "anyOf" in key:
        return " or ".join(_allowed(part) for part in key["anyOf"] if part.get("type") != "null")
    if "enum" in key:
        return ", ".join(f"`{json.dumps(value)}`" for value in key["enum"])
    if key.get("type") == "array":
        parts = key.get("prefixItems") or [key.get("items", {})]
        least, most = key.get("minItems"), key.get("maxItems")
        count = f"{least} " if least and least == most else f"at most {most} " if most else ""
        return f"{count}x ({_allowed(parts[0])})" if count else f"list of ({_allowed(parts[0])})"
    plain = {"number": "number", "integer": "integer", "string": "text", "boolean": "true, false", "object": "table"}
    bounds = [text.format(f"{key[name]:.10g}") for name, text in _BOUNDS.items() if name in key]
    return ", ".join([plain.get(key.get("type", ""), "value"), *bounds])


if __name__ == "__main__":
    for name, text in pages().items():
        (Path(sys.argv[1]) / name).write_text(text, encoding="utf-8")
