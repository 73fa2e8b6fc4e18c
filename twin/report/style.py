"""Colours, labels and matplotlib settings shared by all figures."""

from typing import Any

#: Colour of each plotted quantity, by key. Those of the estimates are from the palette of Okabe & Ito, distinguishable
#: with colour vision deficiency.
COLOURS = {
    "truth": "#1b2a33",
    "reference": "#9aa8b0",
    "f2f": "#d55e00",
    "chain": "#cc79a7",
    "online": "#0072b2",
    "final": "#009e73",
    "limit": "#cc3311",
    "link": "#7f96a3",
    "hole": "#e9b8a8",
    "filled": "#f0b429",
}
LABELS = {
    "truth": "true",
    "reference": "planned",
    "f2f": "frame-to-frame (F2F) only",
    "chain": "chain of links",
    "online": "online estimate",
    "final": "final, after global alignment",
}
ESTIMATES = ("f2f", "online", "final")
#: matplotlib settings of every figure.
FIGURE_STYLE: dict[Any, Any] = {
    "figure.dpi": 110,
    "savefig.dpi": 110,
    "figure.constrained_layout.use": True,
    "font.size": 9,
    "text.parse_math": False,  # names may contain "$"
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.edgecolor": "#5d6d76",
    "axes.grid": True,
    "grid.color": "#e3e9ec",
    "axes.axisbelow": True,
    "legend.frameon": False,
    "lines.linewidth": 1.4,
    "image.interpolation": "nearest",
}


def rgb(role: str) -> tuple[int, int, int]:
    """Returns the colour of `role`, a key of `COLOURS`, as (red, green, blue), each 0 to 255."""
    text = COLOURS[role]
    return int(text[1:3], 16), int(text[3:5], 16), int(text[5:7], 16)
