"""The command line: exit status, what goes to stdout and stderr, and nothing written where nothing was flown."""

import json
import os
import signal
import subprocess
import sys
import time
import types
from pathlib import Path

import pytest

import twin
from scenes.gl import INSTALL_LINE
from twin import cli
from twin.app import console, doctor
from twin.errors import TwinError

ROOT = Path(__file__).parent.parent
NUMBERS = dict.fromkeys(
    ("ate_rmse_m", "ate_max_m", "drift_percent", "path_m", "le90_m", "nmad_m", "bias_m", "rmse_m", "cell_m"), 0.012
)
METRICS = {
    "name": "quickstart",
    "seed": 1,
    "status": "complete",
    "reason": "",
    "trajectory": {key: NUMBERS for key in ("f2f", "online", "final")},
    "consistency": {"nees_position_mean": 3.0},
    "map": NUMBERS | {"completeness": 0.98, "sigma_ratio": 1.1},
    "overlap": dict.fromkeys(("along_median", "along_planned", "across_median", "across_planned"), 0.9),
    "control": {"cross_track_rmse_m": 0.02},
    "timing": {"real_time_factor": 1.2, "frames": 10, "keyframes": 2},
    "require": {},
}


def result(**changes):
    metrics = METRICS | changes
    return types.SimpleNamespace(status=metrics["status"], metrics=metrics, folder=Path("runs/quickstart-1"))


@pytest.fixture
def twin_command(monkeypatch, tmp_path, capsys):
    """Runs the command line in an empty folder, its survey replaced by one whose outcome is given."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(doctor, "graphics", lambda: doctor.Finding("OpenGL", True, "a renderer"))

    def command(*words, outcome=None):
        surveys = []
        fake = types.ModuleType("twin.survey")
        fake.run = lambda *asked: surveys.append(asked) or outcome
        monkeypatch.setitem(sys.modules, "twin.survey", fake)
        monkeypatch.setattr(twin, "survey", fake, raising=False)
        monkeypatch.setattr(sys, "argv", ["twin", *words])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return types.SimpleNamespace(status=end.value.code, surveys=surveys, **capsys.readouterr()._asdict())

    return command


@pytest.mark.parametrize(
    ("changes", "status"),
    [
        ({}, 0),
        ({"require": {"map.le90_m": {"value": 0.04, "limit": 0.05, "passed": True}}}, 0),
        ({"require": {"map.le90_m": {"value": 0.06, "limit": 0.05, "passed": False}}}, 1),
        ({"status": "aborted", "reason": "vision lost"}, 1),
        ({"status": "aborted", "reason": "No space left on device"}, 1),
        ({"status": "aborted", "reason": "interrupted"}, 130),
    ],
)
def test_the_exit_status_tells_how_the_survey_went(twin_command, changes, status):
    assert twin_command("run", "quickstart", outcome=result(**changes)).status == status


def test_json_is_all_that_stands_on_stdout(twin_command):
    done = twin_command("run", "quickstart", "--json", outcome=result())
    assert json.loads(done.out) == METRICS


def test_the_error_table_and_the_report_stand_on_stdout(twin_command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("runs/quickstart-1").mkdir(parents=True)
    for name in ("report.html", "run.rrd"):
        Path("runs/quickstart-1", name).touch()
    done = twin_command("demo", outcome=result())
    assert done.status == 0 and "1.2 cm" in done.out and "98.0 %" in done.out
    assert done.out.endswith("Open the recording: twin view runs/quickstart-1\n")


def test_a_missed_requirement_is_named(twin_command):
    missed = {"map.le90_m": {"value": 0.06, "limit": 0.05, "passed": False}}
    assert "MISSED" in twin_command("run", "quickstart", outcome=result(require=missed)).out


def test_options_reach_the_survey(twin_command):
    words = ("run", "quickstart", "--set", "plan.tracks=1", "--set", "water.jerlov=II", "--seed", "7", "--out", "here")
    scenario, out, _, live = twin_command(*words, outcome=result()).surveys[0]
    assert (scenario.plan.tracks, scenario.water.jerlov, scenario.seed) == (1, "II", 7)
    assert (out, live, scenario.source.path.name) == (Path("here"), False, "quickstart.toml")


@pytest.mark.parametrize(
    ("words", "fault"),
    [
        (["run", "quikstart"], "quikstart: no such scenario (did you mean quickstart?)"),
        (["run", "quickstart", "--set", "plan.overlap_along=1"], "--set: plan.overlap_along: 1: not allowed"),
        (["plan", "quickstart", "--set", "plan.area_m=[90.0,2.0]"], "--set: plan.area_m: 90 x 2 m is larger"),
        (["report", "nowhere"], "nowhere: is no run folder"),
        (["run", "quickstart", "--out", str(ROOT)], f"--out: {ROOT} is there and not empty"),
        (["run", "quickstart", "--seed", "-1"], "Invalid value for '--seed'"),
        (["run"], "Missing argument 'SCENE'"),
        (["fly"], "No such command 'fly'"),
    ],
)
def test_a_fault_of_the_user_ends_with_2_a_line_on_stderr_and_nothing_written(twin_command, tmp_path, words, fault):
    done = twin_command(*words)
    assert (done.status, done.out, done.surveys) == (2, "", [])
    assert fault in done.err and "Traceback" not in done.err
    assert not list(tmp_path.iterdir())


def test_without_opengl_doctors_line_is_told_and_nothing_written(twin_command, tmp_path, monkeypatch):
    monkeypatch.setattr(doctor, "graphics", lambda: doctor.Finding("OpenGL", False, "no EGL", "sudo apt-get install x"))
    done = twin_command("run", "quickstart", outcome=result())
    assert (done.status, done.out, done.surveys) == (2, "", [])
    assert done.err == "LACKING  OpenGL: no EGL\n         mend it by: sudo apt-get install x\n"
    assert not list(tmp_path.iterdir())


def test_runs_of_one_name_and_seed_are_counted(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scenario = types.SimpleNamespace(name="reef", seed=3)
    folders = []
    for _ in range(3):
        folders.append(cli._new_folder(scenario, None))
        folders[-1].mkdir(parents=True)
        (folders[-1] / "log.jsonl").touch()
    assert [str(f) for f in folders] == ["runs/reef-3", "runs/reef-3-2", "runs/reef-3-3"]


def test_an_empty_folder_is_used_and_a_file_is_not(tmp_path):
    assert cli._new_folder(None, tmp_path) == tmp_path
    (tmp_path / "file").touch()
    for taken in (tmp_path, tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(TwinError, match="--out"):
            cli._new_folder(None, taken)


def test_the_schema_describes_every_section(twin_command):
    from twin.scenario.model import Scenario

    schema = json.loads(twin_command("schema").out)
    assert set(schema["properties"]) == set(Scenario.model_fields)


def test_the_plan_is_a_table_and_a_picture(twin_command, tmp_path):
    done = twin_command("plan", "quickstart", "--set", "terrain.kind=flat", "--out", "plan.png")
    assert done.status == 0 and "frames per keyframe N" in done.out
    assert (tmp_path / "plan.png").read_bytes()[:4] == b"\x89PNG"


def test_progress_tells_simulated_time_real_time_factor_and_believed_error():
    now = types.SimpleNamespace(simulated_s=30.0, wall_s=20.0, share=0.5, sigma_m=0.013, stage="survey")
    assert console.note(now) == "30.0 s simulated, 1.50 x real time, position ± 1.3 cm"


def test_a_terminal_gets_a_bar_and_a_pipe_gets_none(capsys):
    with console.progress_bar() as progress:
        progress(types.SimpleNamespace(simulated_s=1.0, wall_s=1.0, share=0.5, sigma_m=0.0, stage="survey"))
    assert capsys.readouterr() == ("", "")


def probe(**environment):
    command = [sys.executable, "-m", "twin.app.doctor"]
    return subprocess.run(command, env=os.environ | environment, capture_output=True, text=True, cwd=ROOT, check=False)


def test_the_doctor_draws_a_frame():
    done = probe()
    assert done.returncode == 0 and done.stdout.strip()


def test_the_doctor_survives_a_machine_without_a_driver(monkeypatch):
    done = probe(MUJOCO_GL="egl", __EGL_VENDOR_LIBRARY_DIRS="/nonexistent")
    assert done.returncode == 1 and "no OpenGL on this machine" in done.stderr
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: done)
    finding = doctor.graphics()
    assert not finding.ok and INSTALL_LINE in str(finding)


def test_a_crash_of_the_driver_is_a_finding(monkeypatch):
    killed = subprocess.CompletedProcess([], -11, "", "")
    monkeypatch.setattr(doctor.subprocess, "run", lambda *_, **__: killed)
    assert doctor.graphics().found == "drawing ended with status -11"


@pytest.mark.slow
def test_ctrl_c_ends_a_survey_that_can_be_read(tmp_path):
    out = tmp_path / "run"
    survey = subprocess.Popen(
        [sys.executable, "-m", "twin", "run", "quickstart", "--out", str(out), "--json"],
        stdout=subprocess.PIPE,
        cwd=ROOT,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # also where this one ignores it
    )
    deadline = time.monotonic() + 120
    while len(list(out.glob("keyframes/*"))) < 5 and time.monotonic() < deadline:
        time.sleep(0.2)
    survey.send_signal(signal.SIGINT)
    printed, _ = survey.communicate(timeout=120)
    assert survey.returncode == 130
    metrics = json.loads((out / "metrics.json").read_text())
    assert metrics == json.loads(printed)
    assert (metrics["status"], metrics["reason"]) == ("aborted", "interrupted")
    assert metrics["trajectory"]["final"]["path_m"] > 0 and (out / "report.html").is_file()


def test_set_up_installs_what_the_doctor_asks_for():
    packages = INSTALL_LINE.split("install -y ")[1].split()
    assert set(packages) <= set((ROOT / ".ci" / "system-packages").read_text().replace('"', " ").split())


def test_constraints_name_versions_and_nothing_else():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert lines and all(len(line.split("==")) == 2 and not set(line) & set(" @/:") for line in lines)
