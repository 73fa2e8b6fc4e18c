"""All experiments of `twin reproduce`: each one writes its results to a folder and returns them."""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from twin.core.user_files import read_json
from twin.errors import TwinError
from twin.reproduce import index_page
from twin.reproduce.exhibit import SCHEMA, Exhibit, Figure, exhibit_of, make_table

#: Function that runs an experiment: takes its folder, and whether to run the quick version; returns the results.
Experiment = Callable[[Path, bool], Exhibit]
RESULTS_FILE, PAGE_FILE = "results.json", "index.html"


def _paper(folder: Path, quick: bool) -> Exhibit:
    from twin.reproduce import paper

    return paper.run(folder, quick)


def _tank1(folder: Path, quick: bool) -> Exhibit:
    from twin.reproduce import tank

    return tank.run("tank1", folder, quick)


def _tank2(folder: Path, quick: bool) -> Exhibit:
    from twin.reproduce import tank

    return tank.run("tank2", folder, quick)


def _budget(folder: Path, quick: bool) -> Exhibit:
    from twin.reproduce import budget

    return budget.run(folder, quick)


def _turbidity(folder: Path, quick: bool) -> Exhibit:
    from twin.reproduce import turbidity

    settings = ("rig.image_width_px=240", "rig.image_height_px=180") if quick else ()
    summary = turbidity.write(turbidity.render_levels(settings=settings), folder)
    text = "A concrete block on rippled sand in water of Jerlov type II at five turbidities, lit by two lamps (Fig. 8)."
    table = make_table("turbidity", f"Block at {summary['range_m']:.2f} m in green light", turbidity.table(summary))
    figure = Figure("turbidity.png", "Images, histograms, and contrast of fine detail against range.")
    return Exhibit("turbidity", "Turbidity", text, (table,), (figure,))


def _light(folder: Path, quick: bool) -> Exhibit:
    from twin.reproduce import daylight, light

    found = list(light.cells(light.QUICK if quick else light.ALL))
    under_sun = list(daylight.daylight_cells(daylight.QUICK_DAYLIGHT if quick else daylight.ALL_DAYLIGHT))
    light.write(found, folder)
    daylight.write_daylight(under_sun, folder)
    text = "The light model of the images compared with a Monte Carlo of any order of scattering, green band."
    tables = (
        make_table("light", "Lamps", light.table(found)),
        make_table("daylight", "Daylight", daylight.daylight_table(under_sun)),
    )
    figure = Figure("light.png", "Light model and Monte Carlo reference; bars: two standard errors.")
    return Exhibit("light", "Light of lamps and sun", text, tables, (figure,))


#: The experiments, in the order of the index page.
EXPERIMENTS: dict[str, Experiment] = {
    "paper": _paper,
    "tank1": _tank1,
    "tank2": _tank2,
    "turbidity": _turbidity,
    "light": _light,
    "budget": _budget,
}


def run_all(
    folder: Path, quick: bool, names: Sequence[str] = tuple(EXPERIMENTS), report: Callable[[str], None] = lambda _: None
) -> list[Exhibit]:
    """Runs experiments, each in a subfolder of its name, and writes results.json and index.html.

    results.json and the page are written again after each experiment, so that an interrupt does not lose finished ones.

    Args:
        folder: folder to write, created if missing.
        quick: whether to run smaller, quick versions of the experiments.
        names: the experiments to run.
        report: called after each experiment with a line of text: its name and computing time.

    Raises:
        TwinError: a name is not that of an experiment.
    """
    for name in names:
        if name not in EXPERIMENTS:
            raise TwinError("experiment", f"{name!r} is unknown", ", ".join(EXPERIMENTS))
    found: list[Exhibit] = []
    for name in names:
        start = time.monotonic()
        found.append(EXPERIMENTS[name](folder / name, quick))
        write_all(found, folder, quick)
        report(f"{name}: {time.monotonic() - start:.0f} s")
    return found


def write_all(exhibits: Sequence[Exhibit], folder: Path, quick: bool) -> None:
    """Writes results.json and index.html to a folder, which is created if missing."""
    folder.mkdir(parents=True, exist_ok=True)
    contents = {"schema": f"{SCHEMA}s", "quick": quick, "exhibits": [exhibit.as_dict() for exhibit in exhibits]}
    (folder / RESULTS_FILE).write_text(json.dumps(contents, indent=1) + "\n", encoding="utf-8")
    (folder / PAGE_FILE).write_text(index_page.render(exhibits, quick), encoding="utf-8")


def read_all(file: Path) -> tuple[list[Exhibit], bool]:
    """Returns the exhibits in a results.json, and whether they are those of the quick versions.

    Raises:
        TwinError: the file cannot be read or is not a results.json.
    """
    contents = read_json(file, "", "results.json of `twin reproduce all`")
    if not isinstance(contents, dict) or not isinstance(contents.get("exhibits"), list):
        raise TwinError(str(file), "has no list of exhibits", "results.json of `twin reproduce all`")
    return [exhibit_of(entry, file) for entry in contents["exhibits"]], bool(contents.get("quick"))
