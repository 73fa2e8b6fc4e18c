"""Figure of the turbidity levels: images, their histograms, and contrast as a function of range."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from numpy.typing import NDArray

from twin.core.records import Image
from twin.imaging.light.water import Medium
from twin.report.figures import log_axis
from twin.reproduce.exhibit import drawn
from twin.scenario.model import Scenario

BANDS = (("red", "#d55e00"), ("green", "#009e73"), ("blue", "#0072b2"))
PANEL_IN = 3.1
#: Contrast relative to clear water below which fine detail counts as invisible.
MIN_VISIBLE_CONTRAST = 0.05


class TurbidityLevel(NamedTuple):
    """Results for one turbidity level."""

    scenario: Scenario  #: scenario with this turbidity
    water: Medium  #: optical properties of the water
    image: Image  #: (H, W, 3) image of the left camera
    quality: dict[str, Any]  #: measures of the quality of `image`, see `twin.app.look.image_quality`
    ranges_m: NDArray[np.float64]  #: (n,) ranges at which `contrast` is given
    contrast: NDArray[np.float64]  #: (n, 3) contrast of fine detail relative to clear water for R, G, B

    @property
    def visibility_m(self) -> float | None:
        """Returns the shortest range [m] with a green contrast below `MIN_VISIBLE_CONTRAST`; None if there is none."""
        invisible = np.flatnonzero(self.contrast[:, 1] < MIN_VISIBLE_CONTRAST)
        return float(self.ranges_m[invisible[0]]) if invisible.size else None


def draw(levels: Sequence[TurbidityLevel], file: Path) -> None:
    """Draws the figure to a PNG file."""
    height, width = levels[0].image.shape[:2]
    image_in = PANEL_IN * height / width
    with drawn(file, PANEL_IN * len(levels), image_in + 1.6 + 3.4 + 0.6) as figure:
        grid = figure.add_gridspec(3, len(levels), height_ratios=[image_in, 1.6, 3.4])
        figure.suptitle(_title(levels), fontsize=12)
        top = max(_histogram_of(level.image, band).max() for level in levels for band in range(3))
        for k, level in enumerate(levels):
            _picture(figure.add_subplot(grid[0, k]), level)
            _histogram(figure.add_subplot(grid[1, k]), level, top, first=k == 0)
        _curves(figure.add_subplot(grid[2, :]), levels)


def _title(levels: Sequence[TurbidityLevel]) -> str:
    return (
        f"One object at {len(levels)} turbidity levels: scattering of Jerlov type {levels[0].scenario.water.jerlov} "
        f"multiplied by the turbidity, two lamps, equal mean exposure, "
        f"{levels[0].quality['depth_median_m']:.2f} m below the camera"
    )


def _picture(axes: Axes, level: TurbidityLevel) -> None:
    axes.imshow(level.image)
    axes.set_axis_off()
    c = level.water.attenuation_per_m[1]
    axes.set_title(f"turbidity {level.scenario.water.turbidity:g}   (green c = {c:.2f} /m)", loc="left")


def _histogram_of(image: Any, band: int) -> Any:
    """Returns the histogram (128,) of a colour band: the fraction of pixels in each bin of two grey levels."""
    return np.histogram(image[..., band], bins=128, range=(0, 256))[0] / image[..., band].size


def _histogram(axes: Axes, level: TurbidityLevel, top: float, first: bool) -> None:
    centres = np.arange(128) * 2 + 1
    for band, (name, colour) in enumerate(BANDS):
        share = 100 * _histogram_of(level.image, band)
        axes.fill_between(centres, share, color=colour, alpha=0.25, linewidth=0)
        axes.plot(centres, share, color=colour, linewidth=1.1, label=name)
    axes.set(xlim=(0, 255), ylim=(0, 105 * top), xticks=[0, 64, 128, 192, 255], xlabel="grey level")
    deviations = ", ".join(f"{sd:.0f}" for sd in level.image.std(axis=(0, 1)))
    axes.text(0.98, 0.93, f"SD {deviations}", transform=axes.transAxes, ha="right", va="top", color="#44545c")
    if first:
        axes.set_ylabel("pixels [%]")
        axes.legend(loc="upper right", bbox_to_anchor=(1.0, 0.9), fontsize=8, handlelength=1.2)
    else:
        axes.tick_params(labelleft=False)


def _curves(axes: Axes, levels: Sequence[TurbidityLevel]) -> None:
    shades = matplotlib.colormaps["viridis"](np.linspace(0.0, 0.85, len(levels)))
    image_range_m, ranges_m = levels[0].quality["depth_median_m"], levels[0].ranges_m
    for level, shade in zip(levels, shades, strict=True):
        green = level.contrast[:, 1]
        visibility = "" if level.visibility_m is None else f": visible to {level.visibility_m:.1f} m"
        label = f"turbidity {level.scenario.water.turbidity:g}{visibility}"
        axes.plot(ranges_m, green, color=shade, linewidth=2, label=label)
        axes.plot(image_range_m, np.interp(image_range_m, ranges_m, green), "o", color=shade, markersize=6)
    axes.axhline(MIN_VISIBLE_CONTRAST, color="#cc3311", linestyle="--", linewidth=1)
    limit = f"{MIN_VISIBLE_CONTRAST:.0%}: limit of visibility"
    axes.text(ranges_m[-1], MIN_VISIBLE_CONTRAST * 1.1, limit, color="#cc3311", ha="right")
    axes.axvline(image_range_m, color="#9aa8b0", linewidth=1)
    axes.text(image_range_m * 1.02, 1.15, "range of the images above", color="#5d6d76")
    axes.set(
        xlim=(ranges_m[0], ranges_m[-1]), ylim=(0.003, 1.5), xlabel="range [m]",
        ylabel="contrast relative to clear water", title="Contrast of fine detail against range, green light",
    )  # fmt: skip
    log_axis(axes.yaxis, lambda share: f"{100 * share:g} %")
    axes.legend(loc="upper right", bbox_to_anchor=(1.0, 0.92))
