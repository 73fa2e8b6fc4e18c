"""What the figures of all reports share: files, axes, legends, hill shading."""

import base64
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.colors import LightSource, Normalize
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, MaxNLocator

from twin.core.georeference import Georeference
from twin.core.records import MapGrid
from twin.report.images import jpeg_bytes, png_bytes
from twin.report.style import FIGURE_STYLE

WIDTH_IN = 9.6
PHOTOS = ("mosaic",)  #: figures that are written as JPEG
PAD_IN = 0.08  #: white margin around a figure


def drawn(functions: Mapping[str, Callable[..., Figure | None]], *data: Any) -> dict[str, str]:
    """Returns the data URI of each figure that a function of `data` draws, by name of the figure."""
    with matplotlib.rc_context(FIGURE_STYLE):
        figures = {name: draw(*data) for name, draw in functions.items()}
        return {name: to_data_uri(figure, name in PHOTOS) for name, figure in figures.items() if figure is not None}


@contextmanager
def png_figure(file: Path, width_in: float, height_in: float, grid: bool = True) -> Iterator[Figure]:
    """Opens an empty figure in the style of the reports, and writes it to a PNG file at the end."""
    with matplotlib.rc_context({**FIGURE_STYLE, "axes.grid": grid}):
        figure = Figure(figsize=(width_in, height_in))
        yield figure
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(png_bytes(_pixels(figure)))


def to_data_uri(figure: Figure, photo: bool = False) -> str:
    """Returns a figure without its white margins as data URI, PNG or, of a photo, JPEG."""
    pixels = _pixels(figure)
    inked = (pixels != 255).any(axis=2)
    rows, cols = (np.flatnonzero(inked.any(axis=axis)) for axis in (1, 0))
    pad = round(PAD_IN * figure.dpi)
    kept = tuple(slice(max(0, at[0] - pad), at[-1] + pad + 1) for at in (rows, cols)) if len(rows) else ()
    data = jpeg_bytes(pixels[kept], max(pixels.shape)) if photo else png_bytes(pixels[kept])
    return f"data:image/{'jpeg' if photo else 'png'};base64," + base64.b64encode(data).decode()


def _pixels(figure: Figure) -> np.ndarray:
    """Returns the pixels (rows, cols, 3) of a figure, which `savefig` of matplotlib would draw twice."""
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    return np.asarray(canvas.buffer_rgba())[..., :3]


def one_panel(height_in: float) -> tuple[Figure, Axes]:
    """Returns a figure of the usual width with one pair of axes."""
    figure = Figure(figsize=(WIDTH_IN, height_in))
    return figure, figure.add_subplot()


def legend_beside(axes: Axes) -> None:
    axes.legend(loc="upper left", bbox_to_anchor=(1.01, 1))


def extent_of(grid: MapGrid) -> tuple[float, float, float, float]:
    """Returns west, east, south and north of a grid [m], for pictures of it."""
    return grid.west_m, grid.west_m + grid.cols * grid.cell_m, grid.north_m - grid.rows * grid.cell_m, grid.north_m


def add_coordinates(axes: Axes, origin: Georeference | None) -> None:
    """Adds axes of easting and northing above and on the right of a map of a scene whose origin is in a CRS."""
    if origin is None:
        return
    unit, k = "m" if origin.metres_per_unit == 1 else f"{origin.metres_per_unit:.7g} m", origin.metres_per_unit
    east = axes.secondary_xaxis("top", functions=_linear(origin.easting, k))
    north = axes.secondary_yaxis("right", functions=_linear(origin.northing, k))
    for axis, name in ((east.xaxis, "easting"), (north.yaxis, "northing")):
        axis.set_label_text(f"{name} [{unit}]")
        axis.set_major_locator(MaxNLocator(4))
        axis.set_major_formatter(lambda value, _: f"{value:.10g}")
        axis.set_tick_params(labelsize=7, labelrotation=90 if name == "northing" else 0)


def _linear(first: float, metres_per_unit: float) -> tuple[Callable[[Any], Any], Callable[[Any], Any]]:
    return lambda m: first + m / metres_per_unit, lambda c: (c - first) * metres_per_unit


def log_scale(axes: Axes) -> None:
    """Makes the y axis logarithmic, from 0.7 times the 1st percentile of the positive values; linear if none is."""
    sizes = np.concatenate([np.zeros(0), *(np.asarray(curve.get_ydata(), dtype=float) for curve in axes.lines)])
    sizes = sizes[sizes > 0]
    if len(sizes):
        log_axis(axes.yaxis)
        axes.set_ylim(0.7 * float(np.percentile(sizes, 1)), None)


class _RoundNumbers(LogLocator):
    """Ticks at 1, 2 and 5, at 1 and 3 or at 1 times powers of 10: the most whose labels do not touch."""

    def tick_values(self, vmin: float, vmax: float) -> Any:
        axis: Any = self.axis
        space = max(axis.get_tick_space() // (2 if axis.axis_name == "x" else 1), 1)  # labels are broader than high
        decades = 10.0 ** np.arange(np.floor(np.log10(vmin)), np.log10(vmax) + 1)
        shown = decades
        for steps in ((1, 2, 5), (1, 3), (1,)):
            ticks = np.outer(decades, steps).ravel()
            shown = ticks[(ticks >= vmin) & (ticks <= vmax)]
            if 0 < len(shown) <= space:
                break
        return shown[:: -(-len(shown) // space) or 1]


def log_axis(axis: Any, label: Callable[[float], str] = "{:g}".format) -> None:
    """Makes an x or y axis logarithmic, with labels at round numbers; the default formatter would write raw markup."""
    axis.axes.set(**{f"{axis.axis_name}scale": "log"})
    axis.set_major_locator(_RoundNumbers())
    axis.set_major_formatter(lambda value, _: label(value))
    axis.set_minor_formatter(lambda *_: "")


def height_scale(heights: np.ndarray) -> tuple[float, float]:
    """Returns the 0.5th and 99.5th percentile of the finite heights [m]; (0, 1) if there are none."""
    finite = heights[np.isfinite(heights)]
    low, high = np.percentile(finite, [0.5, 99.5]) if len(finite) else (0.0, 1.0)
    return float(low), float(high)


def hillshade(heights: np.ndarray, cmap: str, scale: tuple[float, float] | None = None) -> np.ndarray:
    """Returns RGBA (rows, cols, 4) of heights [m] within `scale`, lit from the north-west; clear without data."""
    empty = ~np.isfinite(heights)
    low, high = scale or height_scale(heights)
    filled = np.clip(np.where(empty, (low + high) / 2, heights), low, high)
    shaded = LightSource(315, 45).shade(
        filled, matplotlib.colormaps[cmap], Normalize(low, high), "soft",
        vert_exag=0.12 * max(heights.shape) / ((high - low) or 1.0),
    )  # fmt: skip
    shaded[..., 3] = ~empty
    return shaded
