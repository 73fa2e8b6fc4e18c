"""Report of a search: tuning.html, pareto.png, and the plan: recommended.toml, or candidate.toml if it is not shown."""

from importlib.metadata import version
from itertools import combinations
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from twin.core.user_files import read_text
from twin.report.html import Paragraph, lines_of, render_page, render_paragraphs, render_text
from twin.report.plotting import log_axis, to_data_uri
from twin.report.style import COLOURS, FIGURE_STYLE
from twin.report.words import values_in_words
from twin.scenario.file import dump_toml
from twin.studies import sentences
from twin.studies.conditions import condition_lines, varied_in_words
from twin.studies.report import json_tree
from twin.studies.study_figures import axis_label, key_label, make_panels, metric_axis, value_axis
from twin.tuning.candidates import VISIBILITY, Candidate, pareto_front, required_probability, tuning_config
from twin.tuning.rounds import TuningResult
from twin.tuning.verification import Verification

RECOMMENDED, UNPROVEN = "recommended.toml", "candidate.toml"  #: files of the plan
_DOT = {"linestyle": "", "marker": "o", "markersize": 4}
Groups = list[tuple[list[Candidate], dict[str, Any]]]


def write_tuning_report(result: TuningResult, folder: Path) -> None:
    """Writes tuning.html, pareto.png and the scenario of the recommended or unproven plan to a folder."""
    shown = [candidate for candidate in result.candidates if candidate.has_metrics]
    front = pareto_front(result.candidates, tuning_config(result.study))
    groups, figures, compared = _groups(shown, front, result), {}, compared_plans(result)
    known = {n for c in compared for n, (_, flown) in c.verification.medians.items() if flown is not None}
    known.discard(VISIBILITY)  # the same for all plans
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
        "paragraphs": paragraphs(result),
        "warnings": warnings(result),
        "figures": figures,
        "compared": compared,
        "metrics": [name for name in (compared[0].verification.medians if compared else ()) if name in known],
        "required": required_probability(result.study),
        "chosen": result.recommended or result.unproven,
        "plan": plan_toml(result),
        "plan_file": plan_file(result),
        "text": read_text(result.study.source.path),
        "version": version("seabed-twin"),
    }
    (folder / "tuning.html").write_text(render_page("twin.tuning", "tuning.html.j2", page), encoding="utf-8")
    for name in (RECOMMENDED, UNPROVEN):
        (folder / name).unlink(missing_ok=True)  # of an earlier call
    if name := page["plan_file"]:
        (folder / name).write_text(page["plan"], encoding="utf-8")


def paragraphs(result: TuningResult) -> list[Paragraph]:
    """Returns what the search answers, how sure it is, what it assumes, what breaks and limits it."""
    chosen, failed = result.recommended or result.unproven, result.failed_cheaper
    limits = result.study.limits or (result.scenario.require if result.scenario else {})
    known = {
        "result": result,
        "chosen": chosen,
        "found": result.verification(chosen),
        "failed": failed,
        "failed_values": failed and [values_in_words(key, [v]) for key, v in failed.surrogate.values.items()],
        "limits": sentences.limits_in_words(limits),
        "required": required_probability(result.study),
        "varied": varied_in_words(result.study),
        "conditions": condition_lines(result.study),
        "sentences": sentences,
    }
    return render_paragraphs("tuning_answer.txt.j2", known, "twin.tuning")


def headline(result: TuningResult) -> str:
    return lines_of(paragraphs(result))


class ComparedPlan(NamedTuple):
    """Row of the comparison of the recommended plan with the starting plan and the next cheaper one that failed."""

    name: str
    verification: Verification
    note: str  #: what the rendered surveys show, or why the plan is not recommended


def compared_plans(result: TuningResult) -> list[ComparedPlan]:
    recommended, rows = result.verification(result.recommended), []
    if result.start:
        rows.append(ComparedPlan("starting plan", result.start, "; ".join(result.start.reasons) or "for comparison"))
    if recommended:
        rows.append(ComparedPlan("recommended", recommended, recommended.state()))
    elif unproven := result.verification(result.unproven):
        rows.append(ComparedPlan("closest, not shown", unproven, unproven.state()))
    if cheaper := result.failed_cheaper:
        rows.append(ComparedPlan("next cheaper, not shown", cheaper, cheaper.why_not()))
    return rows


def warnings(result: TuningResult) -> list[str]:
    """Returns warnings on errors of the surrogate, refused plans, and of surveys."""
    chosen = result.verification(result.recommended)
    known = {"result": result, "flown": [chosen] if chosen else result.verifications, "sentences": sentences}
    return render_text("tuning_warnings.txt.j2", known, "twin.tuning").splitlines()


def summary(result: TuningResult) -> dict[str, Any]:
    chosen, names = result.recommended or result.unproven, tuning_config(result.study)
    verification = result.verification(chosen)
    plan = chosen and {
        "values": chosen.values,
        "objectives": dict(zip(names.objectives, chosen.objectives, strict=True)),
        "probability": chosen.pass_probability._asdict(),
        "shown": result.recommended is not None,
        "rendered": verification and _rendered(verification),
    }
    found = {
        "name": result.study.name,
        "candidates": len(result.candidates),
        "interrupted": result.interrupted,
        "out_of_time": result.out_of_time,
        "recommended": plan if result.recommended else None,
        "unproven": plan if result.unproven else None,
        "start": result.start and _rendered(result.start),
        "verifications": [_rendered(one) for one in result.verifications],
        "warnings": warnings(result),
        "headline": headline(result),
    }
    return json_tree(found)


def _rendered(verification: Verification) -> dict[str, Any]:
    return {
        "plan": verification.surrogate.number,
        "round": verification.search_round,
        "shown": verification.shown,
        "probability": verification.probability._asdict(),
        "needed": verification.needed,
        "reasons": verification.reasons,
        **{name: getattr(verification, name) for name in ("surveys", "n_passed", "n_failed")},
        "values": verification.surrogate.values,
        "medians": {
            name: {"surrogate": surrogate, "rendered": rendered, "ratio": verification.ratio.ratios[name]}
            for name, (surrogate, rendered) in verification.medians.items()
        },
    }


def plan_file(result: TuningResult) -> str:
    """Returns the name of the file of the plan; "" if there is none."""
    return RECOMMENDED if result.recommended else UNPROVEN if result.unproven else ""


def plan_toml(result: TuningResult) -> str:
    """Returns the plan, if any, as a scenario file with headline and warnings in comments at the start."""
    if result.scenario is None:
        return ""
    imaging = result.scenario.imaging.model_copy(update={"fidelity": "rendered"})
    comments = [f"twin tune of {result.study.name}", *headline(result).splitlines()]
    comments += [f"Warning: {text}" for text in warnings(result)]
    scenario = result.scenario.model_copy(update={"imaging": imaging})
    return "".join(f"# {' '.join(line.split())}\n" for line in comments) + dump_toml(scenario)


def _groups(shown: list[Candidate], front: list[Candidate], result: TuningResult) -> Groups:
    chosen = result.recommended or result.unproven
    label = "recommended" if result.recommended else "closest, not shown"
    star = {"marker": "*", "markersize": 13, "color": COLOURS["limit"], "label": label}
    unlikely = _DOT | {"color": COLOURS["f2f"], "alpha": 0.5, "label": "pass probability too low"}
    feasible = _DOT | {"color": COLOURS["link"], "label": "feasible"}
    return [
        ([c for c in shown if c.shortfall > 0], unlikely),
        ([c for c in shown if c.shortfall <= 0 and c not in front], feasible),
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
        axes.set_xlabel(key_label(key))
        _format_axis(axes.yaxis, config.objectives[k])
    return figure


def _format_axis(axis: Any, objective: str) -> None:
    metric_axis(axis, objective)
    if axis.get_scale() == "linear":
        axis.set_major_locator(MaxNLocator(4))  # few ticks, as their labels are long
    axis.set_label_text(axis_label(objective))
