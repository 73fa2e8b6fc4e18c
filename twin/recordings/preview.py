"""Preview of a data set: one sheet of its first stereo pair: matches, disparity, light before and after."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from twin.estimate.first_pair import LightInspection, inspect_light
from twin.recordings.replay import OpenedDataset
from twin.report.number_formats import length, percent, plain

_N_LINES = 9  # number of epipolar lines
_N_PAIRS = 24  # largest number of pairs from which the light of the cameras is estimated
_FEWEST_PAIRS = 8  # from fewer pairs, the mean shows the floor rather than the light
_WIDTH_IN = 12.0


def light_of(opened: OpenedDataset) -> LightInspection:
    """Returns the light of the cameras, from pairs spread over the data set, and the first pair without it."""
    return inspect_light(opened.pair, opened.frames.spread(_N_PAIRS), opened.frames.rectification.rig)


def draw(opened: OpenedDataset, light: LightInspection, file: Path) -> Path:
    """Writes the figure as PNG and returns `file`, whose name is not changed.

    First row: the rectified pair with some epipolar lines, which are image rows, and the matched points, coloured by
    disparity. Second row: before and after the light of the cameras was made uniform in the left image. Third row:
    dense disparity of the images as recorded, and as the map uses it. Fourth row: a histogram of the row differences of
    the matched points, and the mean grey levels of both cameras along the rows of the images.
    """
    pair = opened.pair
    height_in = 1.6 * _WIDTH_IN * pair.rig.height_px / pair.rig.width_px + 1.6
    figure = Figure(figsize=(_WIDTH_IN, height_in), layout="constrained")
    axes = figure.subplots(4, 2, height_ratios=(1, 1, 1, 0.7))
    _draw_matches(axes[0], opened)
    _draw_image(axes[1, 0], pair.left, "before: left image as recorded")
    _draw_even_image(axes[1, 1], light)
    _draw_disparities(axes[2], pair.disparity.disparity_px, light)
    _draw_row_differences(axes[3, 0], pair.points.row_difference_px)
    _draw_light(axes[3, 1], light)
    figure.savefig(file, dpi=110, format="png")
    return file


def rows(opened: OpenedDataset, light: LightInspection) -> list[tuple[str, ...]]:
    """Returns the rows of a table of the properties of a data set and its first pair: name, value, remark."""
    pair, rig = opened.pair, opened.pair.rig
    remark = f". {opened.depth_note}" if opened.depth_note else ""
    found = opened.frames
    depth_m = pair.points.xyz[:, 2]
    subtracted = "subtracted before dense matching" if light.subtracted else "not subtracted: the texture dominates"
    seen = (light.mean_left > 0) & (light.mean_right > 0)  # without the margins of rectified images
    right_share = float(light.mean_right[seen].mean() / light.mean_left[seen].mean()) if seen.any() else np.nan
    corner_share = _corner_light(light.mean_left) if light.n_pairs >= _FEWEST_PAIRS else np.nan
    return [
        ("reader", opened.reader, opened.plane_text),
        ("frames", str(len(found)), f"{plain(rig.frame_rate_hz)} Hz"),
        ("images", f"{rig.width_px} x {rig.height_px} px", found.rectification.sentence),
        ("focal length, baseline", f"{plain(rig.focal_px)} px", length(rig.baseline_m)),
        ("matched points", str(len(depth_m)),
         f"disparity at {percent(_known_share(pair.disparity.disparity_px))} of the pixels"),
        ("row difference", f"{np.median(pair.points.row_difference_px):+.2f} px", "median, right minus left"),
        ("depth", length(float(np.median(depth_m))), "median; 5th and 95th percentile "
         + " and ".join(length(float(value)) for value in np.percentile(depth_m, [5, 95])) + remark),
        ("light at the corners", "unknown" if np.isnan(corner_share) else f"{100 * corner_share:.0f} %",
         f"of the centre, left camera; {subtracted}"),
        ("right camera", f"{100 * right_share:.0f} %",
         f"of the grey level of the left one; number of pairs: {light.n_pairs}"),
        ("truth", "none" if opened.truth is None else f"{len(opened.truth)} poses", "only for the comparison"),
    ]  # fmt: skip


def _corner_light(mean: NDArray[np.float32]) -> float:
    height, width = mean.shape
    down, across = -(-height // 10), -(-width // 10)
    corners = [part for rows in (mean[:down], mean[-down:]) for part in (rows[:, :across], rows[:, -across:])]
    middle = mean[(height - down) // 2 : (height + down) // 2, (width - across) // 2 : (width + across) // 2]
    return float(np.mean(corners) / max(float(middle.mean()), 1e-6))


def _known_share(disparity_px: NDArray[np.float32]) -> float:
    return float(np.isfinite(disparity_px).mean())


def _draw_matches(axes: Sequence[Axes], opened: OpenedDataset) -> None:
    pair, (left, right) = opened.pair, axes
    disparity_px, pixels = pair.points.measured[:, 2] * pair.rig.focal_px, pair.points.pixels
    _draw_image(left, pair.left, f"{opened.name}: left image, {len(disparity_px)} matched points", _N_LINES)
    _draw_image(right, pair.right, f"right image, baseline {length(pair.rig.baseline_m)}", _N_LINES)
    in_right = pixels[:, 0] - disparity_px, pixels[:, 1] + pair.points.row_difference_px
    for one, (x, y) in ((left, pixels.T), (right, in_right)):
        one.scatter(x, y, s=6, c=disparity_px, cmap="turbo", linewidths=0)


def _draw_even_image(axes: Axes, light: LightInspection) -> None:
    if light.n_pairs < _FEWEST_PAIRS:
        axes.set_title(f"after: light unknown from fewer than {_FEWEST_PAIRS} pairs")
        axes.set_axis_off()
        return
    title = f"after: even light, by the mean of {light.n_pairs} pairs (colours of the map)"
    _draw_image(axes, light.even_left, title)


def _draw_disparities(axes: Sequence[Axes], recorded_px: NDArray[np.float32], light: LightInspection) -> None:
    low, high = np.nanpercentile(recorded_px, [1, 99])
    mapped = "without the light" if light.subtracted else "the same: texture dominates"
    for one, disparity_px, title in (
        (axes[0], recorded_px, "disparity before"),
        (axes[1], light.disparity.disparity_px, f"disparity of the map, {mapped}"),
    ):
        shown = one.imshow(disparity_px, cmap="turbo", vmin=low, vmax=high)
        one.set_title(f"{title}, {percent(_known_share(disparity_px))} of the pixels")
        one.figure.colorbar(shown, ax=one, label="[px]", shrink=0.8, extend="both")


def _draw_row_differences(axes: Axes, difference_px: NDArray[np.floating]) -> None:
    axes.hist(difference_px, bins=50, range=(-1, 1), color="#4477aa")
    axes.axvline(0, color="k", linewidth=0.8)
    axes.set(xlabel="row of the right point minus row of the left point [px]", ylabel="matched points")
    axes.set_title("row differences: centred at 0 if the calibration fits")


def _draw_light(axes: Axes, light: LightInspection) -> None:
    """Draws the mean grey level of each column of the images of both cameras, without columns that are always black."""
    for mean, name, colour in ((light.mean_left, "left", "#4477aa"), (light.mean_right, "right", "#ee6677")):
        axes.plot(np.where(mean.any(axis=0), mean.mean(axis=0), np.nan), color=colour, label=name)
    axes.set(xlabel="column [px]", ylabel="grey level")
    axes.set_ylim(bottom=0)
    axes.set_title(f"light of the cameras: mean of the columns, {light.n_pairs} pairs")
    axes.legend()


def _draw_image(axes: Axes, image: np.ndarray, title: str, n_lines: int = 0) -> None:
    axes.imshow(image)
    for row in np.linspace(0, image.shape[0], n_lines + 2)[1:-1]:
        axes.axhline(row, color="w", linewidth=0.5, alpha=0.6)
    axes.set_title(title)
    axes.set_axis_off()
