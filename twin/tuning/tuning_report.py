"""Report of a search: tuning.html, pareto.png and recommended.toml."""

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

from twin.core.user_files import read_text
from twin.report.html import render_page
from twin.report.number_formats import percent, plain
from twin.report.plotting import log_axis, to_data_uri
from twin.report.style import COLOURS, FIGURE_STYLE
from twin.scenario.file import dump_toml
from twin.studies import sentences
from twin.studies.sentences import metric_name, metric_value
from twin.studies.study_figures import axis_label, make_panels, metric_axis, value_axis
from twin.tuning.candidates import Candidate, pareto_front, required_probability, tuning_config
from twin.tuning.rounds import TuningResult
from twin.tuning.verification import Verification

NOT_VERIFIED = (
    "Not verified: the plan has no rendered surveys (verify = 0), and the surrogate's prediction may not hold."
)
_LARGE_RATIO = 1.5  # a median ratio rendered / surrogate above this value, or below its inverse, gives a warning
_DOT = {"linestyle": "", "marker": "o", "markersize": 4}
Groups = list[tuple[list[Candidate], dict[str, Any]]]


def write_tuning_report(result: TuningResult, folder: Path) -> None:
    """Writes tuning.html, pareto.png and, if a plan is recommended, recommended.toml to a folder."""
    shown = [candidate for candidate in result.candidates if candidate.has_metrics]
    front = pareto_front(result.candidates, tuning_config(result.study))
    groups, figures = _groups(shown, front, result), {}
    with matplotlib.rc_context(FIGURE_STYLE):
        trade_off = _trade_off_figure(groups, result)
        if shown:
            keys = _searched_keys_figure(groups, result)
            figures = {"trade_off": to_data_uri(trade_off), "searched_keys": to_data_uri(keys)}
        trade_off.savefig(folder / "pareto.png")
    page = {
        "study": result.study,
        "config": result.study.tune,
        "result": result,
        "front": front,
        "sentences": sentences,
        "headline": headline(result),
        "warnings": warnings(result),
        "figures": figures,
        "recommended": recommended_toml(result),
        "text": read_text(result.study.source.path),
        "version": version("seabed-twin"),
    }
    (folder / "tuning.html").write_text(render_page("twin.tuning", "tuning.html.j2", page), encoding="utf-8")
    if page["recommended"]:
        (folder / "recommended.toml").write_text(page["recommended"], encoding="utf-8")


def headline(result: TuningResult) -> str:
    """Returns the main result: the recommended plan with its medians and pass probability, or why there is none."""
    count = f"{len(result.candidates)} plans were evaluated"
    if n_rendered := len(result.verifications):
        count += f", {n_rendered} of them also in rendered surveys"
    if (chosen := result.recommended) is None:
        return f"No plan is recommended: {_missing_plan(result, count)}"
    plan = "Recommended plan: " + ", ".join(f"{key} = {plain(value)}" for key, value in chosen.values.items())
    passing = f"pass probability with new seeds {sentences.confidence(chosen.pass_probability)}"
    if (verification := result.recommended_verification) is None:
        named = (*zip(tuning_config(result.study).objectives, chosen.objectives, strict=True), *chosen.completeness)
        objectives = ", ".join(f"{metric_name(n)} {metric_value(n, v)}" for n, v in named if n != "risk")
        unverified = f" {NOT_VERIFIED}" if result.needs_rendering else ""
        return f"{plan}. Medians: {objectives}; {passing}. {count}.{unverified}"
    medians = ", ".join(
        f"{metric_name(name)} {metric_value(name, rendered)} ({metric_value(name, surrogate)})"
        for name, (surrogate, rendered) in verification.medians.items()
    )
    return (
        f"{plan}. {verification.n_passed} of {verification.surveys} rendered surveys were completed and met every "
        f"requirement ({sentences.confidence(verification.rendered.pass_probability)}). Medians "
        f"rendered (surrogate): {medians}; by the surrogate, {passing}. {count}."
    )


def _missing_plan(result: TuningResult, count: str) -> str:
    if result.interrupted:
        return f"{count}, and the search was interrupted before a plan was confirmed."
    if not result.verifications:
        required = f"the required pass probability of {percent(required_probability(result.study))}"
        return f"{count}, and none reached {required} when flown again with new seeds."
    numbers = np.array([(v.surveys, v.n_passed, v.n_failed) for v in result.verifications])
    surveys, passed, n_failed = numbers.sum(axis=0).tolist()
    failed = f"; {n_failed} more failed because of the computer or the program, --resume flies them" if n_failed else ""
    return (
        f"no plan of the search passed in rendered surveys. {count}; {passed} of {surveys - n_failed} rendered surveys "
        f"passed{failed}."
    )


def warnings(result: TuningResult) -> list[str]:
    """Returns warnings on a plan that was not verified, errors of the surrogate, refused plans, and of surveys."""
    chosen = result.recommended_verification
    texts = [NOT_VERIFIED] if result.recommended and result.needs_rendering and chosen is None else []
    for verification in [chosen] if chosen else result.verifications:
        texts += _surrogate_errors(verification)
        texts += [f"{text} (in {n} rendered surveys)" for text, n in verification.warnings.items()]
    texts += [
        f"{n} of {len(result.candidates)} plans could not be flown in the search: {reason}"
        for reason, n in result.refused.items()
    ]
    return texts + [f"{text} (in {n} surveys of the finalists by the surrogate)" for text, n in result.warnings.items()]


def _surrogate_errors(verification: Verification) -> Iterator[str]:
    """Yields a sentence for each metric whose medians differ much between surrogate and rendered surveys."""
    for name, ratio in verification.ratio.ratios.items():
        if not 1 / _LARGE_RATIO <= ratio <= _LARGE_RATIO:
            surrogate, rendered = (metric_value(name, value) for value in verification.medians[name])
            yield (
                f"Plan {verification.surrogate.number}: the surrogate is wrong about the {metric_name(name)}: "
                f"{surrogate} expected, {rendered} in rendered surveys."
            )


def summary(result: TuningResult) -> dict[str, Any]:
    chosen, verification, names = result.recommended, result.recommended_verification, tuning_config(result.study)
    recommended = chosen and {
        "values": chosen.values,
        "objectives": dict(zip(names.objectives, chosen.objectives, strict=True)),
        "probability": chosen.pass_probability._asdict(),
        "verified": not result.needs_rendering or verification is not None,
        "rendered": verification and _rendered(verification),
    }
    return {
        "name": result.study.name,
        "candidates": len(result.candidates),
        "interrupted": result.interrupted,
        "recommended": recommended,
        "verifications": [_rendered(one) for one in result.verifications],
        "warnings": warnings(result),
        "headline": headline(result),
    }


def _rendered(verification: Verification) -> dict[str, Any]:
    return {
        "plan": verification.surrogate.number,
        "round": verification.search_round,
        "passed": verification.passed,
        **{name: getattr(verification, name) for name in ("surveys", "n_passed", "n_failed")},
        "values": verification.surrogate.values,
        "medians": {
            name: {"surrogate": surrogate, "rendered": rendered, "ratio": verification.ratio.ratios[name]}
            for name, (surrogate, rendered) in verification.medians.items()
        },
    }


def recommended_toml(result: TuningResult) -> str:
    """Returns the recommended plan, if any, as a scenario file with headline and warnings in comments at the start."""
    if result.scenario is None:
        return ""
    imaging = result.scenario.imaging.model_copy(update={"fidelity": "rendered"})
    comments = [f"twin tune of {result.study.name}", headline(result)]
    comments += [f"Warning: {text}" for text in warnings(result)]
    scenario = result.scenario.model_copy(update={"imaging": imaging})
    return "".join(f"# {' '.join(line.split())}\n" for line in comments) + dump_toml(scenario)


def _groups(shown: list[Candidate], front: list[Candidate], result: TuningResult) -> Groups:
    chosen = result.recommended
    star = {"marker": "*", "markersize": 13, "color": COLOURS["limit"], "label": "recommended"}
    return [
        (
            [c for c in shown if c.shortfall > 0],
            _DOT | {"color": COLOURS["f2f"], "alpha": 0.5, "label": "pass probability too low"},
        ),
        (
            [c for c in shown if c.shortfall <= 0 and c not in front],
            _DOT | {"color": COLOURS["link"], "label": "feasible"},
        ),
        (front, _DOT | {"color": COLOURS["final"], "markersize": 5, "label": "Pareto-optimal"}),
        ([c for c in shown if chosen and c.number == chosen.number], _DOT | star),
    ]


def _trade_off_figure(groups: Groups, result: TuningResult) -> Figure:
    """Returns a scatter plot of the candidates for each pair of objectives, or of a single one by trial number."""
    names = tuning_config(result.study).objectives
    pairs = list(combinations(range(len(names)), 2)) or [(None, 0)]
    figure, panels = make_panels(len(pairs))
    for (x_index, y_index), axes in zip(pairs, panels, strict=True):
        for candidates, style in groups:
            x = [c.number if x_index is None else c.objectives[x_index] for c in candidates]
            axes.plot(x, [c.objectives[y_index] for c in candidates], **style)
        for axis, k in ((axes.xaxis, x_index), (axes.yaxis, y_index)):
            if k is not None:
                value_axis(axis, np.array([c.objectives[k] for c in result.candidates if c.has_metrics]))
                _format_axis(axis, names[k])
        if x_index is None:
            axes.set_xlabel("trial")
    panels[0].legend(fontsize=8)
    return figure


def _searched_keys_figure(groups: Groups, result: TuningResult) -> Figure:
    config = tuning_config(result.study)
    cells = [(k, key) for k in range(len(config.objectives)) for key in config.search]
    figure, panels = make_panels(len(cells), columns=min(len(config.search), 4))
    for (k, key), axes in zip(cells, panels, strict=True):
        for candidates, style in groups:
            axes.plot([c.values[key] for c in candidates], [c.objectives[k] for c in candidates], **style)
        if config.search[key].kind == "log_uniform":
            log_axis(axes.xaxis)
        axes.set_xlabel(key)
        _format_axis(axes.yaxis, config.objectives[k])
    return figure


def _format_axis(axis: Any, objective: str) -> None:
    metric_axis(axis, objective)
    if axis.get_scale() == "linear":
        axis.set_major_locator(MaxNLocator(4))  # few ticks, as their labels are long
    axis.set_label_text(axis_label(objective))
