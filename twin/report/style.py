"""Colours, labels and matplotlib settings shared by all figures: `style.toml`."""

import tomllib
from importlib.resources import files
from typing import Any

_STYLE = tomllib.loads(files("twin.report").joinpath("style.toml").read_text(encoding="utf-8"))
COLOURS: dict[str, str] = _STYLE["colours"]  #: colour of each plotted quantity, by key
LABELS: dict[str, str] = _STYLE["labels"]
ESTIMATES = ("f2f", "online", "final")
FIGURE_STYLE: dict[Any, Any] = _STYLE["figure"]  #: matplotlib settings of every figure


def rgb(role: str) -> tuple[int, int, int]:
    """Returns the colour of `role`, a key of `COLOURS`, as (red, green, blue), each 0 to 255."""
    text = COLOURS[role]
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)
