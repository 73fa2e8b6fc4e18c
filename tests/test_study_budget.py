"""A budget is honoured, progress says how much time is left, and what the surrogate refuses can be flown rendered."""

import time

import numpy as np
import pytest
from study_surveys import STUDY, SerialEngine, fly, study_of

from twin.app import study_command
from twin.errors import TwinError
from twin.report.number_formats import duration
from twin.studies import progress, runner, sentences
from twin.studies.flight import row_of
from twin.studies.progress import StudyProgress, study_progress
from twin.studies.run_time import parsed_duration, rendered_time


@pytest.fixture(autouse=True)
def _no_report(monkeypatch):
    monkeypatch.setattr(runner, "write_report", lambda analysis, page: None)


@pytest.mark.parametrize(
    ("text", "seconds"), [("90s", 90), ("45m", 2700), ("2h", 7200), ("1h30m", 5400), (" 1.5 H ", 5400), ("1d", 86400)]
)
def test_a_budget_is_a_number_with_a_unit(text, seconds):
    assert parsed_duration(text, "--budget") == seconds


@pytest.mark.parametrize("text", ["", "2", "h", "2 hours", "-2h", "0s", "2h x", "1e3s"])
def test_another_text_is_refused_with_what_is_allowed(text):
    with pytest.raises(TwinError, match=r"^--budget: .* is not a duration \(allowed: a number with s, m, h or d"):
        parsed_duration(text, "--budget")


@pytest.mark.long
def test_a_budget_that_is_too_small_for_one_survey_is_refused_before_any_flight(tmp_path):
    study_of(tmp_path, STUDY)
    for command in (study_command.fly_study, study_command.fly_search):
        text = STUDY + ('[tune]\nobjectives = ["map.le90_m"]\nsearch.plan.speed_mps = { uniform = [0.2, 0.4] }\n')
        file = tmp_path / f"{command.__name__}.toml"
        file.write_text(text)
        with pytest.raises(
            TwinError, match=r"^--budget: 5 s is too short for one survey, which takes about \d+ (s|min)"
        ) as error:
            command(str(file), study_command.StudyOptions(tmp_path / "out", 1, budget="5s"))
        assert "\n" not in str(error.value) and not (tmp_path / "out").exists()


def test_the_surveys_of_a_budget_represent_all_samples_and_resume_flies_the_others(tmp_path, monkeypatch):
    """A grid in its own order would fly the clear water only."""
    changes = (
        ("{ log_uniform = [1.0, 40.0] }", "{ grid = [1.0, 2.0, 4.0, 8.0, 16.0] }"),
        ("{ uniform = [1.6, 2.4] }", "{ grid = [1.6, 1.8, 2.0, 2.2] }"),
        ('"lhs"\nsamples = 12', '"grid"'),
    )
    study, clock = study_of(tmp_path, STUDY, *changes), [0.0]
    monkeypatch.setattr("time.time", lambda: clock[0])

    def ticking(survey):
        clock[0] += 1.0
        return fly(survey)

    first = SerialEngine()
    result = runner.run_study(study, tmp_path / "out", False, runner.Fleet(first, StudyProgress(), ticking, 20.0))
    values = result.analysis.numbers("vary.water.turbidity")
    assert len(values) == len(first.flown) == 20 and not result.interrupted
    assert len(np.unique(values)) == 5  # of 8 surveys each
    assert "20 surveys not flown yet; --resume continues it" in sentences.headline(result.analysis)
    rest = SerialEngine()
    runner.run_study(study, tmp_path / "out", True, runner.Fleet(rest, StudyProgress(), fly))
    assert len(rest.flown) == 20 and not set(first.flown) & set(rest.flown)


def refusing(survey):
    """Flies a survey, which the surrogate refuses at a turbidity above 8; rendered, it takes 10 s per second."""
    is_rendered = survey.scenario.imaging.fidelity == "rendered"
    if survey.values["water.turbidity"] > 8 and not is_rendered:
        return row_of(survey, "refused", "imaging.fidelity: too turbid") | {"unmodelled": True}
    return fly(survey) | {"timing.simulated_s": 50.0, "timing.survey_s": 500.0 if is_rendered else 1.0}


def test_what_the_surrogate_refuses_is_flown_rendered_on_request_with_the_time_told_before(tmp_path, capsys):
    text = STUDY + '[set]\nimaging.fidelity = "surrogate"\n'
    study = study_of(tmp_path, text, ("samples = 12", "samples = 64"))

    def run(resume, **options):
        fleet = runner.Fleet(SerialEngine(), StudyProgress(), refusing)
        return runner.run_study(study, tmp_path / "out", resume, fleet, **options).analysis

    unknown = run(False)
    n = int(unknown.unmodelled.sum())
    known = run(True, render_refused=True)
    line = next(line for line in capsys.readouterr().err.splitlines() if "Flying rendered" in line)
    assert line.startswith(f"Flying rendered what the surrogate refuses, {n} of 64 surveys: about ")
    assert "on one core each (a rough estimate)" in line and line.endswith(" in total")
    assert n > 20 and known.n_rendered == n and not known.unmodelled.any() and known.evaluated.all()
    assert unknown.pass_probability.value < known.pass_probability.value < unknown.pass_probability.most
    assert f"{n} surveys that the surrogate refuses are rendered" in sentences.headline(known)
    truth = [fly(survey) for survey in runner.surveys(study, tmp_path)]
    assert known.passed.sum() == sum(bool(row.get("require.map.le90_m.passed")) for row in truth)
    again = SerialEngine()
    runner.run_study(study, tmp_path / "out", True, runner.Fleet(again, StudyProgress(), refusing), True)
    assert again.flown == []


def test_a_study_of_both_fidelities_cannot_fly_its_refused_surveys_rendered(tmp_path):
    text = STUDY.replace("[vary]", '[vary]\nimaging.fidelity = { grid = ["rendered", "surrogate"] }')
    fleet = runner.Fleet(SerialEngine(), StudyProgress(), fly)
    with pytest.raises(TwinError, match="--render-refused: this study varies imaging.fidelity"):
        runner.run_study(study_of(tmp_path, text), tmp_path / "out", False, fleet, True)


def test_the_time_of_a_rendered_survey_is_that_of_those_flown(tmp_path):
    scenario = next(runner.surveys(study_of(tmp_path, STUDY), tmp_path)).scenario
    row = {"fidelity": "rendered", "timing.simulated_s": 50.0, "timing.survey_s": 500.0}
    assert rendered_time([row, {"fidelity": "surrogate"}], scenario, 20.0) == (200.0, "as measured")
    rough_s, source = rendered_time([], scenario, 20.0)
    assert source == "a rough estimate" and 0 < rough_s < 200
    assert [duration(s) for s in (5, 89, 600, 7200)] == ["5 s", "89 s", "10 min", "2.0 h"]


def row(status="complete"):
    return {"sample": 0, "seed": 1, "status": status, "reason": "", "require.map.le90_m.passed": True}


def test_progress_states_the_time_left_at_the_present_pace(monkeypatch):
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    shown = StudyProgress()
    shown.begin(10)
    assert shown.state() == "0 of 10 surveys, time left not known yet"
    for _ in range(4):
        clock[0] += 30.0
        shown.add(row())
    assert shown.state() == "4 of 10 surveys, 100 % pass (51 to 100 %), about 3 min left"
    shown.begin(14)  # slower surveys follow: their pace is not known
    assert "not known" in shown.state()
    clock[0] += 600.0
    shown.add(row())
    assert shown.state().endswith("about 1.5 h left")
    shown.end_s = time.time() + 60
    assert ", at most " in shown.state() and shown.state().endswith(" s left")


def test_without_a_terminal_progress_is_printed_regularly(monkeypatch, capsys):
    monkeypatch.setattr(progress, "_INTERVAL_S", 0.02)
    with study_progress(False) as shown:
        shown.begin(3)
        shown.add(row())
        time.sleep(0.2)
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) >= 3 and lines[-1].startswith("1 of 3 surveys, 100 % pass (21 to 100 %), about ")


def test_a_study_of_fewer_samples_may_have_no_survey_left_to_fly_rendered(tmp_path):
    text = STUDY.replace("lhs", "random") + '[set]\nimaging.fidelity = "surrogate"\n'

    def run(study, resume, fly, **options):
        fleet = runner.Fleet(SerialEngine(), StudyProgress(), fly)
        return runner.run_study(study, tmp_path / "out", resume, fleet, **options).analysis

    def refusing_the_last(survey):
        refused = row_of(survey, "refused", "imaging.fidelity: too turbid") | {"unmodelled": True}
        return refused if survey.sample >= 6 else fly(survey)

    run(study_of(tmp_path, text), False, refusing_the_last)
    known = run(study_of(tmp_path, text, ("samples = 12", "samples = 6")), True, fly, render_refused=True)
    assert known.n_rendered == 0 and known.evaluated.any()
