"""Preview of a data set: one figure of its first stereo pair with epipolar lines, matched points and disparity."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from twin.datasets.replay import OpenedDataset
from twin.report.wording import length, percent, plain

_N_LINES = 9  # number of epipolar lines
_WIDTH_IN = 12.0


def draw(opened: OpenedDataset, file: Path) -> Path:
    """Writes the figure as PNG and returns `file`.

    Upper row: the rectified pair with some epipolar lines, which are image rows, and the matched points, coloured by
    disparity. Lower row: dense disparity, and a histogram of the row differences of the matched points.

    Args:
        opened: the data set.
        file: file to write; its name is not changed.

    Raises:
        OSError: the file cannot be written.
    """
    pair = opened.pair
    height_in = _WIDTH_IN * pair.rig.height_px / pair.rig.width_px + 0.8
    figure = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
    left, right, dense, rows_axes = figure.subplots(2, 2, squeeze=False).ravel()
    disparity_px = pair.points.measured[:, 2] * pair.rig.focal_px
    _draw_image(left, pair.left, f"{opened.name}: left image, {len(disparity_px)} matched points")
    _draw_image(right, pair.right, f"right image, baseline {length(pair.rig.baseline_m)}")
    pixels = pair.points.pixels
    for axes, x, y in (
        (left, pixels[:, 0], pixels[:, 1]),
        (right, pixels[:, 0] - disparity_px, pixels[:, 1] + pair.points.row_difference_px),
    ):
        axes.scatter(x, y, s=6, c=disparity_px, cmap="turbo", linewidths=0)
    shown = dense.imshow(pair.disparity.disparity_px, cmap="turbo")
    dense.set_title(f"disparity, {percent(_known_share(opened))} of the pixels")
    figure.colorbar(shown, ax=dense, label="[px]", shrink=0.8)
    rows_axes.hist(pair.points.row_difference_px, bins=50, range=(-1, 1), color="#4477aa")
    rows_axes.axvline(0, color="k", linewidth=0.8)
    rows_axes.set(xlabel="row of the right point minus row of the left point [px]", ylabel="matched points")
    rows_axes.set_title("row differences: centred at 0 if the calibration fits")
    figure.savefig(file, dpi=110, format="png")
    return file


def rows(opened: OpenedDataset) -> list[tuple[str, ...]]:
    """Returns the rows of a table of the properties of a data set and its first pair: name, value, remark."""
    pair, rig = opened.pair, opened.pair.rig
    found = opened.frames
    depth_m = pair.points.xyz[:, 2]
    return [
        ("reader", opened.reader, opened.plane_text),
        ("frames", str(len(found)), f"{plain(rig.frame_rate_hz)} Hz"),
        ("images", f"{rig.width_px} x {rig.height_px} px", found.rectification.sentence),
        ("focal length, baseline", f"{plain(rig.focal_px)} px", length(rig.baseline_m)),
        ("matched points", str(len(depth_m)), f"disparity at {percent(_known_share(opened))} of the pixels"),
        ("row difference", f"{np.median(pair.points.row_difference_px):+.2f} px", "median, right minus left"),
        ("depth", length(float(np.median(depth_m))), "median; 5th and 95th percentile "
         + " and ".join(length(float(value)) for value in np.percentile(depth_m, [5, 95]))),
        ("truth", "none" if opened.truth is None else f"{len(opened.truth)} poses", "only for the comparison"),
    ]  # fmt: skip


def _known_share(opened: OpenedDataset) -> float:
    """Returns the fraction of the pixels of the left image of the first pair that have a disparity."""
    return float(np.isfinite(opened.pair.disparity.disparity_px).mean())


def _draw_image(axes: Axes, image: np.ndarray, title: str) -> None:
    """Draws an image with `_N_LINES` epipolar lines and a title, without axes."""
    axes.imshow(image)
    for row in np.linspace(0, image.shape[0], _N_LINES + 2)[1:-1]:
        axes.axhline(row, color="w", linewidth=0.5, alpha=0.6)
    axes.set_title(title)
    axes.set_axis_off()
