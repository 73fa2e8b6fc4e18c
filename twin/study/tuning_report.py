"""tuning.html, pareto.png and recommended.toml: what a search found, and the plan to fly."""

from __future__ import annotations

from collections.abc import Iterator
from importlib.metadata import version
from itertools import combinations
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from twin.report.figures import to_data_uri
from twin.report.html import render_page
from twin.report.style import COLOURS, FIGURE_STYLE
from twin.scenario.file import dump_toml
from twin.study import wording
from twin.study.figures import label_of, log_axis, make_panels, spans_decades, unit_axis
from twin.study.study_file import Study, Tuning
from twin.study.tuning import Candidate, Tuned, best

GOOD, POINTS, BAD = COLOURS["final"], COLOURS["link"], COLOURS["f2f"]


def write_all(study: Study, plan: Tuning, tuned: Tuned, folder: Path) -> None:
    """Writes the page, the picture of the front, and the plan recommended where there is one."""
    shown = [candidate for candidate in tuned.candidates if candidate.has_result]
    with matplotlib.rc_context(FIGURE_STYLE):
        front = pareto(shown, tuned, plan)
        figures = {"pareto": to_data_uri(front), "by_key": to_data_uri(by_key(shown, tuned, plan))} if shown else {}
        front.savefig(folder / "pareto.png")
    page = {
        "study": study,
        "plan": plan,
        "tuned": tuned,
        "front": best(tuned.candidates, plan),
        "words": wording,
        "headline": headline(study, plan, tuned),
        "figures": figures,
        "recommended": recommended_toml(study, plan, tuned),
        "text": study.source.path.read_text(encoding="utf-8"),
        "version": version("seabed-twin"),
    }
    (folder / "tuning.html").write_text(render_page("twin.study", "tuning.html.j2", page), encoding="utf-8")
    if page["recommended"]:
        (folder / "recommended.toml").write_text(page["recommended"], encoding="utf-8")


def headline(study: Study, plan: Tuning, tuned: Tuned) -> str:
    """The answer: the plan to fly, what it is good for, and how probable it is that it passes."""
    tried = f"{len(tuned.candidates)} plans were tried"
    if (chosen := tuned.recommended) is None:
        why = "none was found that" if not tuned.interrupted else "the search was interrupted before a plan"
        return f"No plan is recommended: {tried}, and {why} passes often enough when flown afresh."
    values = ", ".join(f"{key} = {_plain(value)}" for key, value in chosen.values.items())
    good = ", ".join(
        f"{wording.name_of(name)} {value_of(name, value)}"
        for name, value in zip(plan.objectives, chosen.objectives, strict=True)
        if name != "risk"
    )
    passing = f"{wording.passing_of(chosen.share)} of surveys with fresh seeds pass"
    return f"Fly {values}: {good} (medians); {passing}. {tried}."


def summary(study: Study, plan: Tuning, tuned: Tuned) -> dict[str, Any]:
    """What `--json` prints."""
    chosen = tuned.recommended
    recommended = chosen and {
        "values": chosen.values,
        "objectives": dict(zip(plan.objectives, chosen.objectives, strict=True)),
        "probability": chosen.share._asdict(),
    }
    return {"name": study.name, "candidates": len(tuned.candidates), "recommended": recommended}


def value_of(name: str, value: float) -> str:
    """An objective in its unit."""
    return wording.percent(value) if name == "risk" else wording.value_of(name, value)


def recommended_toml(study: Study, plan: Tuning, tuned: Tuned) -> str:
    """The plan recommended as a scenario file, with what is known of it on top; "" where there is none.

    What the surrogate found is to be flown rendered.
    """
    if tuned.scenario is None:
        return ""
    imaging = tuned.scenario.imaging.model_copy(update={"fidelity": "rendered"})
    head = [f"twin tune of {study.name}", headline(study, plan, tuned)]
    return "".join(f"# {line}\n" for line in head) + dump_toml(tuned.scenario.model_copy(update={"imaging": imaging}))


def pareto(shown: list[Candidate], tuned: Tuned, plan: Tuning) -> Figure:
    """Every candidate by each pair of objectives; one objective alone by the order of trial."""
    pairs = list(combinations(range(len(plan.objectives)), 2)) or [(None, 0)]
    figure, axes_of = make_panels(len(pairs))
    for (across, up), axes in zip(pairs, axes_of, strict=True):
        for candidates, style in _groups(shown, tuned, plan):
            x = [c.number if across is None else c.objectives[across] for c in candidates]
            axes.plot(x, [c.objectives[up] for c in candidates], **style)
        for axis, set_scale, k in ((axes.xaxis, axes.set_xscale, across), (axes.yaxis, axes.set_yscale, up)):
            if k is not None:
                values = np.array([c.objectives[k] for c in shown])
                if spans_decades(values):
                    log_axis(axis, set_scale)
                _named(axis, plan.objectives[k])
        if across is None:
            axes.set_xlabel("trial")
    axes_of[0].legend(fontsize=8)
    return figure


def by_key(shown: list[Candidate], tuned: Tuned, plan: Tuning) -> Figure:
    """Each objective against each key that was searched."""
    cells = [(k, key) for k in range(len(plan.objectives)) for key in plan.search]
    figure, axes_of = make_panels(len(cells), columns=min(len(plan.search), 4))
    for (k, key), axes in zip(cells, axes_of, strict=True):
        for candidates, style in _groups(shown, tuned, plan):
            axes.plot([c.values[key] for c in candidates], [c.objectives[k] for c in candidates], **style)
        if plan.search[key].kind == "log_uniform":
            log_axis(axes.xaxis, axes.set_xscale)
        axes.set_xlabel(key)
        _named(axes.yaxis, plan.objectives[k])
    return figure


def _groups(shown: list[Candidate], tuned: Tuned, plan: Tuning) -> Iterator[tuple[list[Candidate], dict[str, Any]]]:
    """Candidates and how they are drawn: too risky, good enough, the front, the one recommended."""
    front = best(tuned.candidates, plan)
    chosen = {tuned.recommended.number} if tuned.recommended else set()
    dot: dict[str, Any] = {"linestyle": "", "marker": "o", "markersize": 4}
    yield [c for c in shown if c.lack > 0], dot | {"color": BAD, "alpha": 0.5, "label": "passes too rarely"}
    yield [c for c in shown if c.lack <= 0 and c not in front], dot | {"color": POINTS, "label": "passes"}
    yield front, dot | {"color": GOOD, "markersize": 5, "label": "beaten by none"}
    star = dot | {"marker": "*", "markersize": 13, "color": COLOURS["limit"], "label": "recommended"}
    yield [c for c in front if c.number in chosen], star


def _named(axis, name: str) -> None:
    if name == "risk":
        axis.set_major_formatter(lambda value, _: wording.percent(value))
    else:
        unit_axis(axis, name)
    if axis.get_scale() == "linear":
        axis.set_major_locator(MaxNLocator(4))  # ticks are words
    axis.set_label_text(label_of(name))


def _plain(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)
