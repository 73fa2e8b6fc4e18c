"""All experiments of `twin reproduce`: each one writes its results to a folder and returns them."""

import time
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from twin.errors import TwinError
from twin.reproduce import light, paper, paper_budget, tank, turbidity
from twin.reproduce.exhibit import Exhibit, write_all

#: The experiments, in the order of the index page: functions of a folder and whether to run the quick version.
EXPERIMENTS: dict[str, Callable[[Path, bool], Exhibit]] = {
    "paper": paper.run,
    "tank1": partial(tank.run, "tank1"),
    "tank2": partial(tank.run, "tank2"),
    "turbidity": turbidity.run,
    "light": light.run,
    "budget": paper_budget.run,
}


def run_all(
    folder: Path, quick: bool, names: Sequence[str] = tuple(EXPERIMENTS), report: Callable[[str], None] = lambda _: None
) -> None:
    """Runs experiments, each in a subfolder of its name; writes results.json and index.html anew after each of them.

    `report` gets a line with name and computing time after each. Raises TwinError if a name is not that of an
    experiment.
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
