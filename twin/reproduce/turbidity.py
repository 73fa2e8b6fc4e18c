"""One object at five turbidities (Fig. 8 of Negahdaripour & Madjidi 2003), and contrast as a function of range."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.axes import Axes

from twin.app.look import image_quality, render_view
from twin.core.geometry import Array
from twin.core.records import Image, StereoRig
from twin.imaging.light.illumination import Illumination
from twin.imaging.light.optics import Optics
from twin.imaging.light.water import Medium
from twin.report.plotting import log_axis, png_figure
from twin.reproduce.exhibit import Exhibit, Figure, make_table, write_json
from twin.reproduce.experiment_floors import block_on_sand
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario
from twin.world.mission import prepare

JERLOV = "II"
TURBIDITIES = (0.0, 0.5, 1.5, 3.0, 6.0)  # values of `water.turbidity`
ALTITUDE_M = 0.9
SETTINGS = (
    f"water.jerlov={JERLOV}", f"plan.altitude_m={ALTITUDE_M}", "plan.area_m=[0.2, 0.2]", "plan.tracks=1",
    "plan.speed_mps=0.05", "rig.image_width_px=480", "rig.image_height_px=360", "terrain.kind=flat",
    "terrain.relief_m=0.0", "imaging.shadows=true",
)  # fmt: skip
QUICK = ("rig.image_width_px=240", "rig.image_height_px=180")
RANGES_M: Array = np.arange(0.3, 12.01, 0.05)
BANDS = (("red", "#d55e00"), ("green", "#009e73"), ("blue", "#0072b2"))
PANEL_IN = 3.1
#: Contrast relative to clear water below which fine detail counts as invisible.
MIN_VISIBLE_CONTRAST = 0.05


class TurbidityLevel(NamedTuple):
    scenario: Scenario
    water: Medium
    image: Image  #: (H, W, 3) image of the left camera
    quality: dict[str, Any]  #: measures of the quality of `image`, see `twin.app.look.image_quality`
    ranges_m: Array  #: (n,) ranges at which `contrast` is given
    contrast: Array  #: (n, 3) contrast of fine detail relative to clear water for R, G, B

    @property
    def visibility_m(self) -> float | None:
        """Returns the shortest range [m] with a green contrast below `MIN_VISIBLE_CONTRAST`; None if there is none."""
        invisible = np.flatnonzero(self.contrast[:, 1] < MIN_VISIBLE_CONTRAST)
        return float(self.ranges_m[invisible[0]]) if invisible.size else None


def run(folder: Path, quick: bool = False) -> Exhibit:
    """Renders the block at all turbidities, writes turbidity.json and turbidity.png, and returns the results."""
    results = write(render_levels(settings=QUICK if quick else ()), folder)
    text = "A concrete block on rippled sand in water of Jerlov type II at five turbidities, lit by two lamps (Fig. 8)."
    found = make_table("turbidity", f"Block at {results['range_m']:.2f} m in green light", table(results))
    figure = Figure("turbidity.png", "Images, histograms, and contrast of fine detail against range.")
    return Exhibit("turbidity", "Turbidity", text, (found,), (figure,))


def render_levels(
    turbidities: Sequence[float] = TURBIDITIES, settings: Sequence[str] = (), ranges_m: Array = RANGES_M
) -> list[TurbidityLevel]:
    """Returns the results at each `water.turbidity`, with further overrides of the scenario ("key=value")."""
    levels, floor = [], block_on_sand(seed=1)
    for turbidity in turbidities:
        scenario = load_scenario("reef", [*SETTINGS, f"water.turbidity={turbidity}", *settings])
        mission = replace(prepare(scenario), terrain=floor)
        view, water = render_view(mission), mission.illumination.water
        contrast = relative_contrast(scenario, mission.illumination, ranges_m)
        levels.append(TurbidityLevel(scenario, water, view.stereo_pair.left, image_quality(view), ranges_m, contrast))
    return levels


def relative_contrast(scenario: Scenario, illumination: Illumination, ranges_m: Array) -> Array:
    """Returns the contrast (n, 3) of fine detail on a level floor at ranges (n,) [m], relative to clear water; R, G, B.

    Only the direct signal carries fine detail; forward scatter (a blur) and backscatter add light without it. The
    contrast C relative to its value C0 in clear water is therefore C / C0 = direct / (direct + forward + backscatter)
    (Duntley 1963, here for lamps that are fixed to the camera).
    """
    rig: StereoRig = replace(scenario.believed_rig(), width_px=64, height_px=48)
    rig = replace(rig, focal_px=rig.focal_px * 64 / scenario.rig.image_width_px)
    optics = Optics(rig, illumination, scenario.lamps)
    floor = np.full((48, 64, 3), 128, np.uint8)
    contrast = np.empty((len(ranges_m), 3))
    for k, range_m in enumerate(ranges_m):
        centre, depth = np.s_[20:28, 28:36], np.full(floor.shape[:2], range_m, np.float32)
        direct, forward, backscatter = optics.parts(floor, depth, 0)
        parts = (direct, backscatter if forward is None else forward + backscatter)
        signal, scattered = (np.mean(part[centre], axis=(0, 1), dtype=np.float64) for part in parts)
        contrast[k] = signal / (signal + scattered)
    return contrast


def table(summary: dict[str, Any]) -> list[tuple[str, ...]]:
    """Returns the values of a summary for the green band as table rows, the header first."""
    header = ("turbidity", "attenuation c", "contrast", "backscatter", "grey level SD", "texture SNR", "visibility")
    max_range_m = summary["contrast_left"]["range_m"][-1]
    rows = [
        (
            f"{row['turbidity']:g}", f"{row['attenuation_per_m'][1]:.2f} /m", f"{row['contrast'][1]:.3f}",
            f"{100 * row['veil_share'][1]:.0f} %", f"{255 * row['gray_level_sd'][1]:.1f}",
            f"{row['texture_snr'][1]:.1f}",
            f"over {max_range_m:.0f} m" if row["visibility_m"] is None else f"{row['visibility_m']:.2f} m",
        )
        for row in summary["levels"]
    ]  # fmt: skip
    return [header, *rows]


def write(levels: Sequence[TurbidityLevel], folder: Path) -> dict[str, Any]:
    """Writes turbidity.png and turbidity.json to a folder, which is created if missing; returns the summary."""
    names = ("gray_level", "contrast", "veil_share", "saturated_share", "snr", "texture_snr")
    results = {
        "schema": "twin.turbidity/1",
        "jerlov": JERLOV,
        "range_m": levels[0].quality["depth_median_m"],
        "levels": [
            {
                "turbidity": level.scenario.water.turbidity,
                "attenuation_per_m": level.water.attenuation_per_m.tolist(),
                "gray_level_sd": (level.image.std(axis=(0, 1)) / 255).tolist(),
                "visibility_m": level.visibility_m,
            }
            | {name: level.quality[name] for name in names}
            for level in levels
        ],
        "contrast_left": {
            "range_m": levels[0].ranges_m.round(3).tolist(),
            "green": [level.contrast[:, 1].round(5).tolist() for level in levels],
        },
    }
    write_json(folder / "turbidity.json", results)
    draw(levels, folder / "turbidity.png")
    return results


def draw(levels: Sequence[TurbidityLevel], file: Path) -> None:
    height, width = levels[0].image.shape[:2]
    image_in = PANEL_IN * height / width
    with png_figure(file, PANEL_IN * len(levels), image_in + 1.6 + 3.4 + 0.6) as figure:
        grid = figure.add_gridspec(3, len(levels), height_ratios=[image_in, 1.6, 3.4])
        title = (
            f"One object at {len(levels)} turbidity levels: scattering of Jerlov type {JERLOV} multiplied by the "
            f"turbidity, two lamps, equal mean exposure, {levels[0].quality['depth_median_m']:.2f} m below the camera"
        )
        figure.suptitle(title, fontsize=12)
        top = max(_histogram_of(level.image, band).max() for level in levels for band in range(3))
        for k, level in enumerate(levels):
            picture = figure.add_subplot(grid[0, k])
            picture.imshow(level.image)
            picture.set_axis_off()
            turbidity, c = level.scenario.water.turbidity, level.water.attenuation_per_m[1]
            picture.set_title(f"turbidity {turbidity:g}   (green c = {c:.2f} /m)", loc="left")
            _histogram(figure.add_subplot(grid[1, k]), level, top, first=k == 0)
        _curves(figure.add_subplot(grid[2, :]), levels)


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
