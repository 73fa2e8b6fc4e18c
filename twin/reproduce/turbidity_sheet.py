"""The sheet of the turbidity ladder: images above their histograms, below them contrast against range."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

from twin.imaging.water import medium
from twin.report.style import FIGURE_STYLE
from twin.reproduce.turbidity import JERLOV, RANGES_M, VISIBLE, Level

BANDS = (("red", "#d55e00"), ("green", "#009e73"), ("blue", "#0072b2"))
PANEL_IN = 3.1


def draw(levels: list[Level], file: Path) -> Path:
    """Writes the sheet as PNG."""
    height, width = levels[0].image.shape[:2]
    image_in = PANEL_IN * height / width
    with matplotlib.rc_context(FIGURE_STYLE):
        figure = Figure(figsize=(PANEL_IN * len(levels), image_in + 1.6 + 3.4 + 0.6))
        grid = figure.add_gridspec(3, len(levels), height_ratios=[image_in, 1.6, 3.4])
        figure.suptitle(_headline(levels), fontsize=12)
        top = max(_share(level.image, band).max() for level in levels for band in range(3))
        for k, level in enumerate(levels):
            _picture(figure.add_subplot(grid[0, k]), level)
            _histogram(figure.add_subplot(grid[1, k]), level, top, first=k == 0)
        _curves(figure.add_subplot(grid[2, :]), levels)
        FigureCanvasAgg(figure).print_png(str(file))
    return file


def _headline(levels: list[Level]) -> str:
    return (
        f"One object at {len(levels)} turbidity levels: scattering of Jerlov type {JERLOV} times the turbidity, two "
        f"lamps, exposed to the same mean, {levels[0].told['depth_median_m']:.2f} m below the camera"
    )


def _picture(axes: Axes, level: Level) -> None:
    axes.imshow(level.image)
    axes.set_axis_off()
    c = medium(level.scenario.water).attenuation_per_m[1]
    axes.set_title(f"turbidity {level.scenario.water.turbidity:g}   (green c = {c:.2f} /m)", loc="left")


def _share(image: Any, band: int) -> Any:
    """Share of pixels in bins of two gray levels."""
    return np.histogram(image[..., band], bins=128, range=(0, 256))[0] / image[..., band].size


def _histogram(axes: Axes, level: Level, top: float, first: bool) -> None:
    middles = np.arange(128) * 2 + 1
    for band, (name, colour) in enumerate(BANDS):
        share = 100 * _share(level.image, band)
        axes.fill_between(middles, share, color=colour, alpha=0.25, linewidth=0)
        axes.plot(middles, share, color=colour, linewidth=1.1, label=name)
    axes.set(xlim=(0, 255), ylim=(0, 105 * top), xticks=[0, 64, 128, 192, 255], xlabel="gray level")
    spread = ", ".join(f"{sd:.0f}" for sd in level.image.std(axis=(0, 1)))
    axes.text(0.98, 0.93, f"spread {spread}", transform=axes.transAxes, ha="right", va="top", color="#44545c")
    if first:
        axes.set_ylabel("pixels [%]")
        axes.legend(loc="upper right", bbox_to_anchor=(1.0, 0.9), fontsize=8, handlelength=1.2)
    else:
        axes.tick_params(labelleft=False)


def _curves(axes: Axes, levels: list[Level]) -> None:
    shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.85, len(levels)))
    at_m = levels[0].told["depth_median_m"]
    for level, shade in zip(levels, shades, strict=True):
        green = level.contrast[:, 1]
        sight = "" if level.sight_m is None else f": lost at {level.sight_m:.1f} m"
        axes.plot(
            RANGES_M, green, color=shade, linewidth=2, label=f"turbidity {level.scenario.water.turbidity:g}{sight}"
        )
        axes.plot(at_m, np.interp(at_m, RANGES_M, green), "o", color=shade, markersize=6)
    axes.axhline(VISIBLE, color="#cc3311", linestyle="--", linewidth=1)
    axes.text(RANGES_M[-1], VISIBLE * 1.1, "5 %: no longer told from what surrounds it", color="#cc3311", ha="right")
    axes.axvline(at_m, color="#9aa8b0", linewidth=1)
    axes.text(at_m * 1.02, 1.15, "the pictures above", color="#5d6d76")
    axes.set(
        xlim=(RANGES_M[0], RANGES_M[-1]), ylim=(0.003, 1.5), yscale="log", xlabel="range [m]",
        ylabel="contrast left, of that in clear water", title="Contrast of fine detail against range, green light",
    )  # fmt: skip
    axes.set_yticks([0.01, 0.1, 1.0], ["1 %", "10 %", "100 %"])
    axes.legend(loc="upper right", bbox_to_anchor=(1.0, 0.92))
