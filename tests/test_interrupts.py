"""Ctrl-C and SIGTERM: each stage of a survey ends alone, and the run folder is readable with metrics.json."""

import json
import os
import signal
import sys
import threading
import time
from typing import Any

import numpy as np
import pytest

import twin.session.conclusion
import twin.session.flown_survey
from twin import cli, survey
from twin.core.interrupts import StageGuard, sigterm_as_interrupt
from twin.core.timing import Stopwatch
from twin.errors import TwinError
from twin.estimate.pipeline import Navigator
from twin.exchange import mesh
from twin.report import recording, survey_page
from twin.report.run_folder import load_run
from twin.report.run_writer import RunFolder, SurveyRecord
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario

SMALL = [
    'imaging.fidelity="surrogate"',
    "plan.area_m=[0.6, 0.5]",
    "plan.tracks=1",
    "control.hold_s=0.2",
    'require."map.le90_area_m"=0.05',
]


@pytest.fixture(autouse=True)
def default_handlers():
    """Installs Python's own handlers, also where the parent process ignores SIGINT, and checks that they come back."""
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler
    for number, handler in before.items():
        signal.signal(number, handler)


def send(number: int = signal.SIGINT) -> None:
    """Sends a signal to this process and waits: the stage is too slow to end by itself."""
    os.kill(os.getpid(), number)
    time.sleep(20)
    pytest.fail("the signal did not end the stage")


def in_first_call(function, number):
    """Returns a function that is interrupted by a signal when it is called first."""
    calls = []

    def interrupted(*arguments, **keywords):
        calls.append(1)
        if len(calls) == 1:
            send(number)
        return function(*arguments, **keywords)

    return interrupted


STAGES = {
    "alignment": (Navigator, "finish"),
    "map": (Navigator, "build_map"),
    "orthomosaic": (twin.session.flown_survey, "make_orthomosaic"),
    "evaluation": (twin.session.conclusion, "evaluate"),
    "maps": (mesh, "write_glb"),
    "report": (survey_page, "write_page"),
    "recording": (recording, "record_run"),
}


def fly(folder, outputs=()):
    return survey.run(load_scenario("reef", SMALL), folder, outputs=outputs)


def checked(folder):
    """Returns the metrics of a run folder, which must be readable and have the files that every run has."""
    run = load_run(folder)
    assert run.finished and {"truth", "f2f", "online", "final"} <= set(run.trajectories)
    assert not list(folder.glob(".*"))
    json.dumps(run.metrics, allow_nan=False)
    return run.metrics


@pytest.mark.parametrize("stage", STAGES)
def test_an_interrupt_ends_only_the_current_stage(tmp_path, monkeypatch, stage):
    owner, name = STAGES[stage]
    for number, (other, written) in {"report": STAGES["report"], "recording": STAGES["recording"]}.items():
        if number != stage:
            monkeypatch.setattr(other, written, lambda run, number=number: (run.folder / number).touch())
    monkeypatch.setattr(owner, name, in_first_call(getattr(owner, name), signal.SIGINT))
    result = fly(tmp_path / "run", ("report", "recording"))
    metrics = checked(tmp_path / "run")
    assert result.metrics == metrics
    assert (metrics["status"], metrics["reason"]) == ("aborted", f"interrupted; {stage} skipped")
    done = {file.name for file in (tmp_path / "run").iterdir()}
    assert {"report", "recording"} - done == {stage} & {"report", "recording"}
    assert ("dem_truth.tif" in done) == (stage != "maps")
    assert ("dem.tif" in done) == ("mosaic.tif" in done) == (stage not in ("maps", "map"))
    evaluated = stage not in ("map", "evaluation")
    assert metrics["require"]["map.le90_area_m"]["passed"] == evaluated
    assert (metrics["trajectory"]["final"]["ate_rmse_m"] is not None) == (stage != "evaluation")
    assert metrics["timing"]["frames"] > 50
    aligned = [line for line in (tmp_path / "run" / "log.jsonl").read_text().splitlines() if '"aligned"' in line]
    assert len(aligned) == (1 if stage == "alignment" else 2)  # of the track, and of all keyframes


@pytest.mark.parametrize("finished", [True, False])
def test_an_interrupt_of_the_map_files_keeps_an_orthomosaic_that_was_finished(tmp_path, monkeypatch, finished):
    def interrupted(folder, _):
        (folder.path / "task_1").mkdir()
        for name in ("dem.tif", "task_1/mosaic.tif"):
            (folder.path / name).touch()
        raise KeyboardInterrupt

    monkeypatch.setattr(RunFolder, "_write_trajectories", lambda *_: None)
    monkeypatch.setattr(RunFolder, "_write_maps", interrupted)
    result: Any = None
    metrics = {"status": "complete", "reason": ""}
    with RunFolder(tmp_path, Scenario(), ()) as folder:
        (tmp_path / "mosaic.tif").touch()
        record = SurveyRecord(result, None, None, None, Stopwatch(), metrics, has_orthomosaic=finished)
        assert folder.finish(record, StageGuard())["reason"] == "interrupted; maps skipped"
    assert list(tmp_path.rglob("*.tif")) == ([tmp_path / "mosaic.tif"] if finished else [])


def test_metrics_that_cannot_be_written_are_an_error_of_the_out_option(tmp_path):
    result: Any = None
    record = SurveyRecord(result, None, None, None, Stopwatch(), {"status": "complete", "reason": ""})
    with RunFolder(tmp_path, Scenario(), None) as folder:
        (tmp_path / "metrics.json").mkdir()
        with pytest.raises(TwinError, match=r"--out: .*metrics.json cannot be written: "):
            folder.finish(record, StageGuard())


def test_an_interrupted_flight_and_an_interrupted_map_are_both_named(tmp_path, monkeypatch):
    def progress(now):
        if now.stage == "survey" and now.share > 0.6:
            send()

    monkeypatch.setattr(Navigator, "build_map", in_first_call(Navigator.build_map, signal.SIGINT))
    result = survey.run(load_scenario("reef", SMALL), tmp_path / "run", progress, outputs=())
    assert checked(tmp_path / "run")["reason"] == result.metrics["reason"] == "interrupted; map skipped"
    assert result.metrics["trajectory"]["online"]["ate_rmse_m"] < 0.05


def test_an_interrupt_before_the_first_frame_leaves_a_run_folder(tmp_path, monkeypatch):
    monkeypatch.setattr(survey, "fly", lambda *_: send())
    result = fly(tmp_path / "run", None)
    written = json.loads((tmp_path / "run" / "metrics.json").read_text())
    assert written == result.metrics and written["reason"] == "interrupted" and written["timing"]["frames"] == 0


def test_the_reason_of_an_abort_comes_before_the_skipped_stages(tmp_path, monkeypatch):
    monkeypatch.setattr("twin.estimate.network.align", lambda *_: (_ for _ in ()).throw(np.linalg.LinAlgError("loose")))
    monkeypatch.setattr(Navigator, "build_map", in_first_call(Navigator.build_map, signal.SIGINT))
    reason = "global alignment failed: loose; map skipped"
    assert fly(tmp_path / "run").metrics["reason"] == reason == checked(tmp_path / "run")["reason"]


@pytest.fixture
def command(monkeypatch, tmp_path):
    """Runs `twin run` on the small survey and returns its exit status."""
    for stage in ("report", "recording"):
        monkeypatch.setattr(*STAGES[stage], lambda *_: None)

    def run(folder):
        words = [word for key in SMALL for word in ("--set", key)]
        monkeypatch.setattr(sys, "argv", ["twin", "run", "reef", *words, "--out", str(folder)])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return end.value.code

    return run


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
@pytest.mark.parametrize("stage", ["flight", "map", "report"])
def test_sigterm_does_what_ctrl_c_does(command, monkeypatch, tmp_path, number, status, stage):
    owner, name = STAGES.get(stage, (Navigator, "align_track"))
    monkeypatch.setattr(owner, name, in_first_call(getattr(owner, name), number))
    before = signal.getsignal(signal.SIGTERM)
    assert command(tmp_path / "run") == status
    assert checked(tmp_path / "run")["reason"] == "interrupted" + (f"; {stage} skipped" if stage != "flight" else "")
    assert signal.getsignal(signal.SIGTERM) is before


@pytest.mark.parametrize(("number", "status"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_command_that_flies_nothing_ends_on_a_signal(command, monkeypatch, tmp_path, number, status):
    monkeypatch.setattr("twin.scenario.file.load_scenario", lambda *_: send(number))
    assert command(tmp_path / "run") == status
    assert not (tmp_path / "run").exists()


def test_other_exit_statuses_are_kept_after_sigterm():
    with pytest.raises(SystemExit) as end, sigterm_as_interrupt():
        try:
            os.kill(os.getpid(), signal.SIGTERM)
        except KeyboardInterrupt:
            sys.exit(1)
    assert end.value.code == 1


def test_an_interrupt_between_stages_ends_the_next_one():
    with StageGuard() as guard:
        os.kill(os.getpid(), signal.SIGINT)  # held back
        assert guard.attempt("one", lambda: 1) is None
        assert guard.attempt("two", lambda: 2) == 2
    assert guard.reason == "interrupted; one skipped"


def test_two_interrupts_end_two_stages():
    with StageGuard() as guard:
        for name in ("one", "two"):
            assert guard.attempt(name, send) is None
        assert guard.attempt("three", lambda: 3) == 3
    guard.cause = "vision lost"
    assert guard.reason == "vision lost; one, two skipped"


def test_the_default_action_of_sigterm_is_kept_without_a_handler():
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    with StageGuard():
        assert signal.getsignal(signal.SIGTERM) == signal.SIG_DFL


def test_other_threads_get_no_handlers():
    found = []

    def use():
        with StageGuard() as guard, sigterm_as_interrupt():
            found.append((guard.attempt("stage", lambda: 1), signal.getsignal(signal.SIGINT)))

    thread = threading.Thread(target=use)
    thread.start()
    thread.join()
    assert found == [(1, signal.default_int_handler)]


@pytest.mark.parametrize(("cause", "ends"), [(KeyboardInterrupt(), True), (ValueError("damaged"), False)])
def test_an_interrupt_while_compiled_code_is_loaded_ends_the_stage(cause, ends):
    """numba then raises a SystemError, with the interrupt as its cause."""

    def load():
        try:
            raise SystemError("unpickling") from cause
        except SystemError as error:
            raise SystemError("dispatcher") from error

    guard = StageGuard()
    if ends:
        assert guard.attempt("flight", load) is None and guard.skipped == ["flight"]
    else:
        with pytest.raises(SystemError):
            guard.attempt("flight", load)
