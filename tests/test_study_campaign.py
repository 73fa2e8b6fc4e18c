"""A study ends with the same table whatever the number of workers and however often it was interrupted."""

import json

import pyarrow.parquet as pq
import pytest
import study_surveys
from study_surveys import STUDY, Here, study_of

from twin.errors import ScenarioError, TwinError
from twin.study import campaign, command, wording
from twin.study.engine import Outcome, connect
from twin.study.flight import flat, has_passed
from twin.study.ledger import Ledger
from twin.study.progress import Progress


@pytest.fixture(autouse=True)
def _no_pictures(monkeypatch):
    """Drawing the report takes longer than all the rest."""
    monkeypatch.setattr(campaign, "write_report", lambda study, found, page: page.write_text("drawn"))


@pytest.fixture
def study(tmp_path):
    return study_of(tmp_path, STUDY, ("samples = 12", "samples = 8\nseeds = 2"))


def conduct(study, folder, engine=None, resume=False, function=study_surveys.fly):
    return campaign.conduct(study, folder, resume, engine or Here(), Progress(), function)


def rows(folder):
    """The table as it stands on disk, without what a clock decides."""
    table = pq.read_table(folder / "results.parquet")
    return table.select([name for name in table.column_names if not name.startswith("timing.")])


@pytest.fixture
def table(study, tmp_path):
    conduct(study, tmp_path / "whole")
    return rows(tmp_path / "whole")


@pytest.mark.parametrize("jobs", [1, 2, 4])
def test_any_number_of_workers_gives_the_same_table(study, table, tmp_path, jobs):
    with connect(jobs) as engine:
        ended = conduct(study, tmp_path / "out", engine)
    assert rows(tmp_path / "out").equals(table)
    assert (ended.unwritten, ended.interrupted) == ([], False)


def test_a_row_is_what_was_varied_how_it_ended_and_every_figure(table):
    assert table.num_rows == 16
    assert table["sample"].to_pylist() == sorted(2 * list(range(8)))
    assert table.column_names == [
        *("sample", "seed", "status", "reason", "scenario_hash"),
        *("vary.plan.altitude_m", "vary.sun.illuminance_lx", "vary.water.jerlov", "vary.water.turbidity"),
        *("map.le90_m", "require.map.le90_m.limit", "require.map.le90_m.passed", "require.map.le90_m.value"),
    ]
    lost = table.filter([value > 25 for value in table["vary.water.turbidity"].to_pylist()])
    assert set(lost["status"].to_pylist()) == {"aborted"}
    assert set(lost["reason"].to_pylist()) == {study_surveys.LOST}


def test_the_pace_is_that_of_what_was_flown_now(study, tmp_path):
    def fly(survey):
        return study_surveys.fly(survey) | {"timing.survey_s": 2.0}

    first = conduct(study, tmp_path / "out", Here(stop_before=5), function=fly).pace
    rest = conduct(study, tmp_path / "out", resume=True, function=fly).pace
    assert [(pace.surveys, pace.worked_s) for pace in (first, rest)] == [(5, 10.0), (11, 22.0)]
    assert wording.pace(600, 300.0, 540.0) == "600 surveys in 300 s, 120 a minute; each took a worker 0.90 s"


def test_a_row_tells_how_often_its_survey_was_tried():
    assert campaign.row_from(Outcome("task", {"status": "complete"}, "", 2))["timing.attempts"] == 2


def test_what_a_killed_study_was_at_is_cleared_away(study, tmp_path):
    """Runs are written under hidden names until they are whole."""
    conduct(study, tmp_path / "out", Here(stop_before=5))
    half = tmp_path / "out" / "runs" / ".00003_s1"
    half.mkdir()
    (half / "log.jsonl").write_text("cut o")
    conduct(study, tmp_path / "out", resume=True)
    assert not half.exists()


def test_a_study_that_was_interrupted_goes_on_where_it_was(study, table, tmp_path):
    first, second = Here(stop_before=5), Here()
    assert conduct(study, tmp_path / "out", first).interrupted
    assert rows(tmp_path / "out").num_rows == 5
    conduct(study, tmp_path / "out", second, resume=True)
    assert rows(tmp_path / "out").equals(table)
    assert len(first.flown) + len(second.flown) == 16
    assert not set(first.flown) & set(second.flown)


def test_only_what_failed_is_flown_again(study, table, tmp_path):
    conduct(study, tmp_path / "out", function=study_surveys.crash_in_murk)
    broken = rows(tmp_path / "out")
    failed = [status == "failed" for status in broken["status"].to_pylist()]
    assert 0 < sum(failed) < 16
    reasons = {reason for reason, bad in zip(broken["reason"].to_pylist(), failed, strict=True) if bad}
    assert {reason.partition(" (")[0] for reason in reasons} == {"ZeroDivisionError: no contrast"}
    again = Here()
    conduct(study, tmp_path / "out", again, resume=True)
    assert len(again.flown) == sum(failed)
    assert rows(tmp_path / "out").equals(table)


def test_a_row_that_was_cut_off_is_flown_again(study, table, tmp_path):
    conduct(study, tmp_path / "out")
    file = tmp_path / "out" / "rows.jsonl"
    file.write_bytes(file.read_bytes()[:-40])
    again = Here()
    conduct(study, tmp_path / "out", again, resume=True)
    assert len(again.flown) == 1
    assert rows(tmp_path / "out").equals(table)


def test_rows_wait_while_the_disk_is_full(tmp_path):
    ledger = Ledger(tmp_path)
    ledger.add({"sample": 0, "seed": 1, "status": "complete"})
    whole, ledger.file = ledger.file, type(tmp_path)("/dev/full")
    ledger.add({"sample": 1, "seed": 1, "status": "complete"})
    with pytest.raises(OSError, match="No space left"):
        ledger.flush()
    ledger.file = whole
    ledger.add({"sample": 2, "seed": 1, "status": "complete"})
    assert [row["sample"] for row in ledger.rows()] == [0, 1, 2]


def test_what_cannot_be_written_is_told(study, tmp_path, monkeypatch):
    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(campaign, "write_parquet", full)
    ended = conduct(study, tmp_path / "out")
    assert ended.unwritten == ["[Errno 28] No space left on device"]
    assert command.exit_status(ended) == 1


def test_a_folder_of_another_study_is_refused(study, tmp_path):
    conduct(study, tmp_path / "out")
    with pytest.raises(TwinError, match="--out: .* is there and not empty"):
        conduct(study, tmp_path / "out")
    other = study_of(tmp_path, STUDY, ("[1.0, 40.0]", "[1.0, 50.0]"))
    with pytest.raises(TwinError, match="--resume: .* holds the surveys of another study"):
        conduct(other, tmp_path / "out", resume=True)


def test_more_samples_of_the_same_draws_can_be_added(tmp_path):
    few = study_of(tmp_path, STUDY, ('"lhs"', '"random"'), ("samples = 12", "samples = 4"))
    conduct(few, tmp_path / "out")
    more, engine = study_of(tmp_path, STUDY, ('"lhs"', '"random"')), Here()
    conduct(more, tmp_path / "out", engine, resume=True)
    assert (len(engine.flown), rows(tmp_path / "out").num_rows) == (8, 12)


def test_nothing_is_flown_where_a_sample_has_a_fault(tmp_path):
    study, engine = study_of(tmp_path, STUDY, ("[1.6, 2.4]", "[-2.0, 2.4]")), Here()
    with pytest.raises(ScenarioError, match="altitude_m"):
        conduct(study, tmp_path / "out", engine)
    assert not engine.flown
    assert not (tmp_path / "out").exists()


SEEK = 'seek = "water.turbidity"'


def test_a_study_that_seeks_a_limit_misses_nothing(tmp_path):
    study = study_of(tmp_path, STUDY, ("probability = 0.8", "probability = 0.99"))
    assert command.exit_status(conduct(study, tmp_path / "out")) == 0


@pytest.mark.parametrize(
    ("function", "probability", "status"),
    [(study_surveys.fly, 0.2, 0), (study_surveys.fly, 0.99, 1), (study_surveys.fail, 0.0, 1)],
)
def test_the_exit_status_tells_whether_enough_surveys_pass(tmp_path, function, probability, status):
    study = study_of(tmp_path, STUDY, ("probability = 0.8", f"probability = {probability}"), (SEEK, ""))
    assert command.exit_status(conduct(study, tmp_path / "out", function=function)) == status


def test_an_interrupted_study_says_so(study, tmp_path):
    assert command.exit_status(conduct(study, tmp_path / "out", Here(stop_before=1))) == 130


def test_figures_keep_their_names_and_those_of_a_clock_are_timing():
    metrics = {
        "name": "reef",
        "map": {"rmse_m": 0.1},
        "tracks": [{"track": 1, "ga_ms": 5.0, "nodes": 7}],
        "require": {"map.rmse_m": {"value": 0.1, "limit": 0.2, "passed": True}},
    }
    row = flat(metrics)
    assert row == {
        "map.rmse_m": 0.1, "timing.tracks.1.ga_ms": 5.0, "tracks.1.nodes": 7, "tracks.1.track": 1,
        "require.map.rmse_m.value": 0.1, "require.map.rmse_m.limit": 0.2, "require.map.rmse_m.passed": True,
    }  # fmt: skip
    assert has_passed(row | {"status": "complete"})
    assert not has_passed(row | {"status": "aborted"})
    assert not has_passed(row | {"status": "complete", "require.map.rmse_m.passed": False})
    assert json.loads(json.dumps(row)) == row
