"""Processing budget of Negahdaripour & Madjidi (2003, section IV): time of each module, at the paper's 30 Hz.

Motion between frames has to be computed within a frame period, and all work on a keyframe within the N = 15 frame
periods up to the next one.
"""

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple

from twin.report.plotting import log_axis, png_figure
from twin.report.stage_tables import KEYFRAME_STAGES
from twin.report.style import COLOURS
from twin.reproduce.exhibit import DASH, Exhibit, Figure, Row, Table, make_table, percent, write_exhibit
from twin.reproduce.paper_flight import fly_aligned
from twin.scenario.file import load_scenario

RATE_HZ, N_FRAMES = 30.0, 15
FRAME_MS, KEYFRAME_MS = 1e3 / RATE_HZ, 1e3 * N_FRAMES / RATE_HZ
FULL = ("navigation.aiding=[]", "plan.tracks=2", "plan.area_m=[6.0, 30.48]", "terrain.size_m=[12.0, 36.0]")
QUICK = ("navigation.aiding=[]", "plan.tracks=1", "plan.area_m=[2.0, 30.48]", "terrain.size_m=[8.0, 36.0]")
PAPER_SIZE = ("rig.image_width_px=320", "rig.image_height_px=240")


class Module(NamedTuple):
    label: str  #: name of the module
    stage: str  #: key of its stage in the stopwatch; "" if it is part of the stage of another module
    unit: str  #: name of the item that one call processes, such as "frame" or "pair"
    paper: str  #: time of the module in the paper's words
    budget_ms: float | None  #: time for one frame or keyframe at the paper's 30 Hz; None if the module has no limit
    per: str  #: "frame", "keyframe", "track" or "survey": unit to which the budget refers


MODULES = (
    Module("F2F, frame-to-frame motion", "f2f", "frame", "with F2M more than twice video rate: < 17 ms on two 100 MHz "
           "Pentiums", FRAME_MS, "frame"),
    Module("F2M, registration with the mosaic (MBP)", "f2m", "keyframe", "as F2F", KEYFRAME_MS, "keyframe"),
    Module("MfRP, motion from relative positions", "", "pair", "a simple calculation", None, "keyframe"),
    Module("SD, stereo disparity", "stereo", "keyframe", "video rate over 5 to 6 levels: 33 ms", KEYFRAME_MS,
           "keyframe"),
    Module("OF, flow to connected keyframes, with MfRP", "flow", "node", "as SD over 1 to 2 levels, for up to 7 pairs",
           KEYFRAME_MS, "keyframe"),
    Module("KPNME, motions between keyframes", "network", "pair", "several times the frame rate: < 33 ms", KEYFRAME_MS,
           "keyframe"),
    Module("GA, global alignment", "ga", "alignment", "less than a few iterations, at the end of a track", None,
           "track"),
    Module("3-D mapping (Kalman filter)", "map", "survey", "after the mission", None, "survey"),
)  # fmt: skip


def run(folder: Path, quick: bool = False) -> Exhibit:
    """Flies a part of the paper's mission, quick: one track; writes budget.json, budget.png; returns the results."""
    flown = fly_aligned(load_scenario("paper", [*(QUICK if quick else FULL), *PAPER_SIZE]))
    n_frames, n_keyframes = len(flown.result.online), len(flown.result.keyframe_rows)
    text = (
        f"Wall time of the estimators on {os.cpu_count()} cores, over {n_frames} frames and {n_keyframes} keyframes of "
        f"the paper's mission at 320 x 240 pixels. At 30 frames per second, a frame leaves {FRAME_MS:.1f} ms, and "
        f"{N_FRAMES} frames from one keyframe to the next {KEYFRAME_MS:.0f} ms."
    )
    table = budget_table(flown.stages, n_frames, n_keyframes)
    caption = "Time of each module per frame or keyframe; red: what the paper's 30 Hz leave for it."
    figure = Figure("budget.png", caption)
    exhibit = write_exhibit(Exhibit("budget", "Processing budget", text, (table,), (figure,)), folder)
    draw(flown.stages, n_keyframes, folder / "budget.png")
    return exhibit


def per_unit_ms(stages: Mapping[str, Any], stage: str, count: int) -> float | None:
    """Returns the total time of a stage per frame or keyframe, of `count` [ms]; None if it never ran or without any."""
    row = stages.get(stage) or {}
    return 1e3 * row["total_s"] / count if row.get("count") and count else None


def keyframe_load_ms(stages: Mapping[str, Any], n_frames: int, n_keyframes: int) -> float | None:
    """Returns the time for the work on one keyframe plus F2F of `N_FRAMES` frames [ms]; None if F2F never ran."""
    f2f = per_unit_ms(stages, "f2f", n_frames)
    work = [per_unit_ms(stages, stage, n_keyframes) for stage in KEYFRAME_STAGES]
    return None if f2f is None else N_FRAMES * f2f + sum(value or 0.0 for value in work)


def budget_table(stages: Mapping[str, Any], n_frames: int, n_keyframes: int) -> Table:
    """Returns the time of each module and of all (`Stopwatch.summary`), the paper's times and the budget at 30 Hz."""
    rows: list[Row] = [("module", "paper (2003)", "ours, mean of a call", "per frame or keyframe", "budget", "share")]
    counts = {"frame": n_frames, "keyframe": n_keyframes}
    for module in MODULES:
        mean = (stages.get(module.stage) or {}).get("mean_ms")
        each = per_unit_ms(stages, module.stage, counts[module.per]) if module.per in counts else None
        rows.append((
            module.label, module.paper, DASH if mean is None else f"{_ms(mean)} per {module.unit}",
            DASH if each is None else f"{_ms(each)} per {module.per}", _ms(module.budget_ms),
            DASH if each is None or module.budget_ms is None else percent(each / module.budget_ms),
        ))  # fmt: skip
    load = keyframe_load_ms(stages, n_frames, n_keyframes)
    rows.append((
        f"all of it: {N_FRAMES} frames of F2F and one keyframe", "0.5 s", DASH, _ms(load), _ms(KEYFRAME_MS),
        DASH if load is None else percent(load / KEYFRAME_MS),
    ))  # fmt: skip
    rate = DASH if not load else f"{RATE_HZ * KEYFRAME_MS / load:.0f} Hz"
    rows.append(("highest frame rate at which all of it keeps up", "30 Hz", DASH, rate, DASH, DASH))
    return make_table("budget", "Time of each module", rows)


def _ms(value: float | None) -> str:
    return DASH if value is None else f"{value:.1f} ms" if value < 100 else f"{value:.0f} ms"


def draw(stages: Mapping[str, Any], n_keyframes: int, file: Path) -> None:
    names = ("f2f", *KEYFRAME_STAGES)
    f2f = (stages.get("f2f") or {}).get("mean_ms") or 0.0
    values = [f2f, *(per_unit_ms(stages, name, n_keyframes) or 0.0 for name in KEYFRAME_STAGES)]
    labels = {module.stage: module.label for module in MODULES}
    with png_figure(file, 9.6, 2.8) as figure:
        axes = figure.add_subplot()
        axes.barh([labels[name] for name in names][::-1], values[::-1], 0.6, color=COLOURS["online"])
        for k, name in enumerate(names[::-1]):
            limit = FRAME_MS if name == "f2f" else KEYFRAME_MS
            axes.plot([limit, limit], [k - 0.4, k + 0.4], color=COLOURS["limit"], linewidth=2)
        axes.set(xlabel="mean time per frame (F2F) or keyframe [ms]")
        log_axis(axes.xaxis)
        axes.grid(visible=False, axis="y")
