"""The results table of a study does not depend on the number of workers or on interruptions."""

import json

import pyarrow.parquet as pq
import pytest
import study_surveys
from study_surveys import STUDY, SerialEngine, study_of

from twin.app import study_command
from twin.engines.engine import open_engine
from twin.engines.worker import Outcome
from twin.errors import EngineLostError, ScenarioError, TwinError
from twin.studies import runner, sentences
from twin.studies.flight import flatten, has_passed
from twin.studies.progress import StudyProgress
from twin.studies.results_log import ResultsLog


@pytest.fixture(autouse=True)
def _no_figures(monkeypatch):
    """Replaces the report, which takes longer than everything else."""
    monkeypatch.setattr(runner, "write_report", lambda analysis, page: page.write_text("report"))


@pytest.fixture
def study(tmp_path):
    return study_of(tmp_path, STUDY, ("samples = 12", "samples = 8\nseeds = 2"))


def run_study(study, folder, engine=None, resume=False, function=study_surveys.fly):
    return runner.run_study(study, folder, resume, runner.Fleet(engine or SerialEngine(), StudyProgress(), function))


def rows(folder):
    """Returns the results table without the columns of measured run times."""
    table = pq.read_table(folder / "results.parquet")
    return table.select([name for name in table.column_names if not name.startswith("timing.")])


@pytest.fixture
def table(study, tmp_path):
    run_study(study, tmp_path / "whole")
    return rows(tmp_path / "whole")


@pytest.mark.long
@pytest.mark.parametrize("jobs", [1, 2, 4])
def test_the_table_does_not_depend_on_the_number_of_workers(study, table, tmp_path, jobs):
    with open_engine(jobs) as engine:
        result = run_study(study, tmp_path / "out", engine)
    assert rows(tmp_path / "out").equals(table)
    assert (result.write_errors, result.interrupted) == ([], False)


def test_a_row_has_the_varied_keys_the_status_and_every_metric(table):
    assert table.num_rows == 16
    assert table["sample"].to_pylist() == sorted(2 * list(range(8)))
    assert table.column_names == [
        *("sample", "seed", "status", "reason", "fidelity", "scenario_hash"),
        *("vary.plan.altitude_m", "vary.sun.illuminance_lx", "vary.water.jerlov", "vary.water.turbidity"),
        *("map.le90_m", "require.map.le90_m.limit", "require.map.le90_m.passed", "require.map.le90_m.value"),
    ]
    lost = table.filter([value > 25 for value in table["vary.water.turbidity"].to_pylist()])
    assert set(lost["status"].to_pylist()) == {"aborted"}
    assert set(lost["reason"].to_pylist()) == {study_surveys.LOST}


def test_the_throughput_counts_only_the_surveys_flown_by_this_call(study, tmp_path):
    def fly(survey):
        return study_surveys.fly(survey) | {"timing.survey_s": 2.0}

    first = run_study(study, tmp_path / "out", SerialEngine(stop_before=5), function=fly).throughput
    rest = run_study(study, tmp_path / "out", resume=True, function=fly).throughput
    assert [(throughput.surveys, throughput.worker_s) for throughput in (first, rest)] == [(5, 10.0), (11, 22.0)]
    assert sentences.throughput(600, 300.0, 540.0) == "600 surveys in 300 s, 120 per minute; mean run time 0.90 s"


def test_a_row_contains_the_number_of_attempts():
    assert runner.row_of_outcome(Outcome("task", {"status": "complete"}, "", 2))["timing.attempts"] == 2


def test_unfinished_run_folders_are_removed_on_resume(study, tmp_path):
    """Runs have a hidden folder until they are complete."""
    run_study(study, tmp_path / "out", SerialEngine(stop_before=5))
    unfinished = tmp_path / "out" / "runs" / ".00003_s1"
    unfinished.mkdir()
    (unfinished / "log.jsonl").write_text("cut o")
    run_study(study, tmp_path / "out", resume=True)
    assert not unfinished.exists()
    with runner.open_folder(tmp_path / "out", resume=True):
        unfinished.mkdir()  # of a survey that exceeds its time
    assert not unfinished.exists()


@pytest.mark.parametrize("line", ['{"sample": 0}', '{"sample": [], "seed": 1}', '{"sample": 0, "seed": 1', "[0]"])
def test_a_damaged_row_counts_as_none(study, tmp_path, line):
    run_study(study, tmp_path / "out")
    table = rows(tmp_path / "out")
    with (tmp_path / "out" / "rows.jsonl").open("a") as file:
        file.write(line + "\n")
    run_study(study, tmp_path / "out", resume=True)
    assert rows(tmp_path / "out").equals(table)


@pytest.mark.parametrize(
    "reason", [KeyboardInterrupt, EngineLostError("--scheduler", "all workers were lost for 300 s")]
)
def test_an_interrupted_study_is_continued_on_resume(study, table, tmp_path, reason):
    first, second = SerialEngine(5, reason), SerialEngine()
    assert run_study(study, tmp_path / "out", first).interrupted
    assert rows(tmp_path / "out").num_rows == 5
    run_study(study, tmp_path / "out", second, resume=True)
    assert rows(tmp_path / "out").equals(table)
    assert len(first.flown) + len(second.flown) == 16
    assert not set(first.flown) & set(second.flown)


def test_only_failed_surveys_are_flown_again(study, table, tmp_path):
    run_study(study, tmp_path / "out", function=study_surveys.crash_in_turbid_water)
    broken = rows(tmp_path / "out")
    failed = [status == "failed" for status in broken["status"].to_pylist()]
    assert 0 < sum(failed) < 16
    reasons = {reason for reason, bad in zip(broken["reason"].to_pylist(), failed, strict=True) if bad}
    assert {reason.partition(" (")[0] for reason in reasons} == {"ZeroDivisionError: no contrast"}
    again = SerialEngine()
    run_study(study, tmp_path / "out", again, resume=True)
    assert len(again.flown) == sum(failed)
    assert rows(tmp_path / "out").equals(table)


def test_a_survey_whose_verdict_is_a_text_is_flown_again(study, table, tmp_path):
    run_study(study, tmp_path / "out")
    file = tmp_path / "out" / "rows.jsonl"
    first, *others = file.read_text().splitlines(keepends=True)
    verdict = next(key for key in json.loads(first) if key.startswith("require.") and key.endswith(".passed"))
    file.write_text("".join([json.dumps(json.loads(first) | {verdict: "yes"}) + "\n", *others]))
    again = SerialEngine()
    run_study(study, tmp_path / "out", again, resume=True)
    assert len(again.flown) == 1
    assert rows(tmp_path / "out").equals(table)


def test_a_survey_with_an_incomplete_row_is_flown_again(study, table, tmp_path):
    run_study(study, tmp_path / "out")
    file = tmp_path / "out" / "rows.jsonl"
    file.write_bytes(file.read_bytes()[:-40])
    again = SerialEngine()
    run_study(study, tmp_path / "out", again, resume=True)
    assert len(again.flown) == 1
    assert rows(tmp_path / "out").equals(table)


def test_rows_stay_in_memory_while_the_disk_is_full(tmp_path):
    log, row = ResultsLog(tmp_path), {"seed": 1, "scenario_hash": "1a", "status": "complete", "reason": ""}
    log.add({"sample": 0} | row)
    file, log.file = log.file, type(tmp_path)("/dev/full")
    log.add({"sample": 1} | row)
    with pytest.raises(OSError, match="No space left"):
        log.flush()
    log.file = file
    log.add({"sample": 2} | row)
    assert [row["sample"] for row in log.rows()] == [0, 1, 2]


def test_write_errors_are_reported(study, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(runner, "write_parquet", full)
    result = run_study(study, tmp_path / "out")
    assert result.write_errors == ["[Errno 28] No space left on device"]
    assert study_command.exit_status(result) == 1


def test_a_folder_of_another_study_is_rejected(study, tmp_path):
    run_study(study, tmp_path / "out")
    with pytest.raises(TwinError, match="--out: .* is not empty .*--resume"):
        run_study(study, tmp_path / "out")
    other = study_of(tmp_path, STUDY, ("[1.0, 40.0]", "[1.0, 50.0]"))
    with pytest.raises(TwinError, match="--resume: .* contains the results of another study"):
        run_study(other, tmp_path / "out", resume=True)


def test_a_folder_with_results_of_other_seeds_only_is_rejected(study, tmp_path):
    run_study(study, tmp_path / "out")
    other = study_of(tmp_path, STUDY, ("samples = 12", "samples = 8\nseed = 500"))
    with pytest.raises(TwinError, match="--resume: .* contains the results of another study"):
        run_study(other, tmp_path / "out", resume=True)


def test_random_samples_can_be_added_to_a_study(tmp_path):
    few = study_of(tmp_path, STUDY, ('"lhs"', '"random"'), ("samples = 12", "samples = 4"))
    run_study(few, tmp_path / "out")
    more, engine = study_of(tmp_path, STUDY, ('"lhs"', '"random"')), SerialEngine()
    run_study(more, tmp_path / "out", engine, resume=True)
    assert (len(engine.flown), rows(tmp_path / "out").num_rows) == (8, 12)


def test_nothing_is_flown_if_every_sample_is_invalid(tmp_path):
    study, engine = study_of(tmp_path, STUDY, ("[1.6, 2.4]", "[-2.0, -1.0]")), SerialEngine()
    with pytest.raises(ScenarioError, match="altitude_m"):
        run_study(study, tmp_path / "out", engine)
    assert not engine.flown
    assert not (tmp_path / "out").exists()


def test_invalid_samples_are_not_flown_and_are_in_the_table_as_refused(tmp_path):
    study = study_of(tmp_path, STUDY, ("[1.6, 2.4]", "[-2.0, 2.0]"), ("samples = 12", "samples = 8\nseeds = 2"))
    first, again = SerialEngine(), SerialEngine()
    run_study(study, tmp_path / "out", first)
    table = rows(tmp_path / "out")
    altitude_m, status = (table[name].to_pylist() for name in ("vary.plan.altitude_m", "status"))
    assert [value <= 0 for value in altitude_m] == [one == "refused" for one in status]
    assert 0 < len(first.flown) == 16 - status.count("refused")
    run_study(study, tmp_path / "out", again, resume=True)
    assert (again.flown, rows(tmp_path / "out").equals(table)) == ([], True)


SEEK = 'seek = "water.turbidity"'


def test_a_study_with_seek_below_its_required_probability_has_exit_status_1(tmp_path):
    study = study_of(tmp_path, STUDY, ("probability = 0.8", "probability = 0.99"))
    assert study_command.exit_status(run_study(study, tmp_path / "out")) == 1


@pytest.mark.parametrize(
    ("function", "probability", "status"),
    [(study_surveys.fly, 0.2, 0), (study_surveys.fly, 0.99, 1), (study_surveys.fail, 0.0, 1)],
)
def test_the_exit_status_is_0_only_if_enough_surveys_pass(tmp_path, function, probability, status):
    study = study_of(tmp_path, STUDY, ("probability = 0.8", f"probability = {probability}"), (SEEK, ""))
    assert study_command.exit_status(run_study(study, tmp_path / "out", function=function)) == status


def test_the_exit_status_of_an_interrupted_study_is_130(study, tmp_path):
    assert study_command.exit_status(run_study(study, tmp_path / "out", SerialEngine(stop_before=1))) == 130


def test_flattened_metrics_keep_their_names_and_run_times_become_timing():
    metrics = {
        "name": "reef",
        "map": {"rmse_m": 0.1},
        "tracks": [{"track": 1, "ga_ms": 5.0, "nodes": 7}],
        "require": {"map.rmse_m": {"value": 0.1, "limit": 0.2, "passed": True}},
    }
    row = flatten(metrics)
    assert row == {
        "map.rmse_m": 0.1, "timing.tracks.1.ga_ms": 5.0, "tracks.1.nodes": 7, "tracks.1.track": 1,
        "require.map.rmse_m.value": 0.1, "require.map.rmse_m.limit": 0.2, "require.map.rmse_m.passed": True,
    }  # fmt: skip
    assert has_passed(row | {"status": "complete"})
    assert not has_passed(row | {"status": "aborted"})
    assert not has_passed(row | {"status": "complete", "require.map.rmse_m.passed": False})
    assert json.loads(json.dumps(row)) == row
