"""Words for metrics and for keys of scenarios: `words.toml`."""

import re
import tomllib
from collections.abc import Sequence
from functools import cache
from importlib.resources import files
from typing import Any

import numpy as np

from twin.report.number_formats import UNITS, unit_of, with_unit


def words(name: str) -> str:
    """Returns a metric or a key of a scenario in words; one without words by its parts, "baseline (rig)"."""
    numbers = [int(number) + 1 for number in re.findall(r"(?<=\.)\d+", name)]
    if known := _known().get(re.sub(r"\.\d+", "", name)):
        return known.format(*numbers)
    section, _, last = name.rpartition(".")
    last = next((last.removesuffix(suffix) for suffix in UNITS if last.endswith(suffix)), last)
    return re.sub(r"[._]", " ", f"{last} ({section})" if section else last)


def with_words(text: str) -> str:
    """Returns a text in which the metrics that have words are replaced by these."""
    return re.sub(r"\b[a-z]\w*(\.\w+)+", lambda found: _known().get(found[0], found[0]), text)


def label(name: str) -> str:
    """Returns the words of a metric or key with its unit, "speed [m/s]", for axes and columns of plain numbers."""
    return f"{words(name)} [{unit}]" if (unit := unit_of(name)) else words(name)


def values_in_words(name: str, values: Sequence[Any]) -> str:
    """Returns values of a key as "speed 0.2 to 0.5 m/s"; vectors of a velocity by their norms, texts as a list."""
    if all(isinstance(value, list | tuple) for value in values) and unit_of(name) == "m/s":
        values = [float(np.linalg.norm(value)) for value in values]
    if not all(isinstance(value, int | float) for value in values):
        return f"{words(name)} {', '.join(dict.fromkeys(map(str, values)))}"
    low, high = (float(f"{value:.3g}") for value in (min(values), max(values)))
    return f"{words(name)} {f'{low:.4g} to ' if low < high else ''}{with_unit(name, high)}"


@cache
def _known() -> dict[str, str]:
    table = tomllib.loads(files("twin.report").joinpath("words.toml").read_text(encoding="utf-8"))
    return table["metrics"] | table["keys"]
