"""The command line: exit status, stdout and stderr; nothing is written if no survey runs."""

import json
import os
import signal
import subprocess
import sys
import time
import types
from importlib.util import find_spec
from pathlib import Path

import pytest

import twin
from twin import cli
from twin.app import console, outputs
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
    "map": NUMBERS | {"completeness": 0.98, "sigma_ratio": 1.1, "completeness_area": 0.97, "le90_area_m": 0.034},
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
    """Runs the command line in an empty folder, with the survey replaced by a given outcome."""
    monkeypatch.chdir(tmp_path)

    def command(*words, outcome=None):
        surveys = []
        fake = types.ModuleType("twin.survey")
        fake.run = lambda *arguments, **_: surveys.append(arguments) or outcome
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
        ({"status": "aborted", "reason": "interrupted; map skipped"}, 130),
        ({"status": "degraded", "reason": "the stereo residuals are too large"}, 1),
    ],
)
def test_the_exit_status_depends_on_the_outcome_of_the_survey(twin_command, changes, status):
    assert twin_command("run", "quickstart", outcome=result(**changes)).status == status


@pytest.mark.parametrize(("command", "units"), [("look", ("[m]", "[m/s]", "[deg/s]")), ("export", ("[m]",))])
def test_the_help_shows_units_in_brackets(twin_command, command, units):
    """Unless they are escaped, Rich takes them for style tags and removes them."""
    text = twin_command(command, "--help").out
    assert all(unit in text for unit in units)


def test_with_json_stdout_contains_nothing_else(twin_command):
    done = twin_command("run", "quickstart", "--json", outcome=result())
    assert json.loads(done.out) == METRICS


def test_key_figures_and_outputs_are_printed_on_stdout(twin_command, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("runs/quickstart-1").mkdir(parents=True)
    for name in ("report.html", "run.rrd"):
        Path("runs/quickstart-1", name).touch()
    done = twin_command("demo", outcome=result())
    assert done.status == 0 and "1.2 cm" in done.out and "98 %" in done.out
    assert done.out.endswith("Open the recording: twin view runs/quickstart-1\n")


def test_a_missed_requirement_is_printed(twin_command):
    missed = {"map.le90_m": {"value": 0.06, "limit": 0.05, "passed": False}}
    assert "MISSED" in twin_command("run", "quickstart", outcome=result(require=missed)).out


def test_options_reach_the_survey(twin_command):
    words = ("run", "quickstart", "--set", "plan.tracks=1", "--set", "water.jerlov=II", "--seed", "7", "--out", "here")
    scenario, out, _, live = twin_command(*words, outcome=result()).surveys[0]
    assert (scenario.plan.tracks, scenario.water.jerlov, scenario.seed) == (1, "II", 7)
    assert (out, live, scenario.source.path.name) == (Path("here"), False, "quickstart.toml")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["run", "quikstart"], "quikstart: no such scenario (did you mean quickstart?)"),
        (["run", "quickstart", "--set", "plan.overlap_along=1"], "--set: plan.overlap_along: 1: not allowed"),
        (["plan", "reef", "--set", "plan.area_m=[90.0,2.0]"], "--set: plan.area_m: 90 x 2 m is larger"),
        (["report", "nowhere"], "nowhere: is not a run folder"),
        (["run", "quickstart", "--out", str(ROOT)], f"--out: {ROOT} is not empty"),
        (["run", "quickstart", "--out", str(ROOT / "README.md")], "README.md is not a folder"),
        (["run", "quickstart", "--seed", "-1"], "Invalid value for '--seed'"),
        (["run"], "Missing argument 'SCENE'"),
        (["fly"], "No such command 'fly'"),
        (
            ["plan", "reef", "--set", "imaging.calibration=x"],
            "imaging.calibration: renamed to imaging.error_model",
        ),
    ],
)
def test_a_user_error_gives_exit_status_2_a_message_on_stderr_and_no_files(twin_command, tmp_path, words, message):
    done = twin_command(*words)
    assert (done.status, done.out, done.surveys) == (2, "", [])
    assert message in done.err and "Traceback" not in done.err
    assert not list(tmp_path.iterdir())


def test_run_folders_of_the_same_name_and_seed_are_numbered(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    scenario = types.SimpleNamespace(name="reef", seed=3)
    folders = []
    for _ in range(3):
        folders.append(outputs.run_folder(scenario))
        folders[-1].mkdir(parents=True)
        (folders[-1] / "log.jsonl").touch()
    assert [str(f) for f in folders] == ["runs/reef-3", "runs/reef-3-2", "runs/reef-3-3"]


def test_a_folder_without_a_survey_cannot_be_resumed(tmp_path):
    with pytest.raises(TwinError, match="no survey to resume"):
        outputs.resumed(tmp_path, None)


def test_an_empty_folder_is_accepted_and_any_other_path_is_not(tmp_path):
    assert outputs.new_folder(tmp_path) == tmp_path
    (tmp_path / "file").touch()
    for taken in (tmp_path, tmp_path / "file", tmp_path / "file" / "below"):
        with pytest.raises(TwinError, match="--out"):
            outputs.new_folder(taken)


def test_the_schema_describes_every_section(twin_command):
    from twin.scenario.model import Scenario

    schema = json.loads(twin_command("schema").out)
    assert set(schema["properties"]) == set(Scenario.model_fields)


def test_the_plan_is_a_table_and_a_picture(twin_command, tmp_path):
    done = twin_command("plan", "reef", "--set", "terrain.kind=flat", "--out", "plan.png")
    assert done.status == 0 and "frames per keyframe N" in done.out
    assert (tmp_path / "plan.png").read_bytes()[:4] == b"\x89PNG"


def test_the_plan_as_json_is_one_object_and_nothing_else(twin_command, tmp_path):
    words = ("plan", "reef", "--set", "terrain.texture_px_m=0.05", "--set", "plan.tracks=1", "--out", "plan.png")
    done = twin_command(*words, "--set", 'require={"map.le90_m"=0.0001}', "--json")
    tree = json.loads(done.out)
    assert (done.status, tree["name"], tree["picture"]) == (0, "reef", "plan.png")
    assert not tree["require"]["map.le90_m"]["passed"]
    strict = twin_command(*words, "--set", 'require={"map.le90_m"=0.0001}', "--strict")
    assert strict.status == 1 and "Warning: map.le90_m is expected to miss its limit" in strict.err


def test_progress_shows_simulated_time_real_time_factor_and_position_error():
    now = types.SimpleNamespace(simulated_s=30.0, wall_s=20.0, share=0.5, sigma_m=0.013, stage="survey")
    assert console.progress_note(now) == "30.0 s simulated, 1.50 x real time, position ± 1.3 cm"


@pytest.mark.parametrize("fidelity", ["rendered", "surrogate"])
def test_the_first_use_is_noted_where_the_code_is_not_compiled(fidelity, capsys, monkeypatch):
    monkeypatch.setattr("twin.kernels.has_code", lambda module: False)
    console.note_first_use(fidelity)
    assert f"The first {fidelity} survey" in capsys.readouterr().err
    monkeypatch.setattr("twin.kernels.has_code", lambda module: find_spec(module) is not None)  # a module that exists
    console.note_first_use(fidelity)
    assert capsys.readouterr() == ("", "")


def test_a_pipe_gets_no_progress_bar(capsys):
    with console.progress_bar() as progress:
        progress(types.SimpleNamespace(simulated_s=1.0, wall_s=1.0, share=0.5, sigma_m=0.0, stage="survey"))
    assert capsys.readouterr() == ("", "")


@pytest.mark.slow
def test_an_interrupted_survey_leaves_a_readable_run_folder(tmp_path):
    out = tmp_path / "run"
    survey = subprocess.Popen(
        [sys.executable, "-m", "twin", "run", "quickstart", "--out", str(out), "--json"],
        stdout=subprocess.PIPE,
        cwd=ROOT,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # also where the parent ignores it
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


def test_constraints_contain_only_exact_versions():
    lines = [line for line in (ROOT / "constraints.txt").read_text().splitlines() if not line.startswith("#")]
    assert lines and all(len(line.split("==")) == 2 and not set(line) & set(" @/:") for line in lines)


@pytest.mark.long
@pytest.mark.parametrize("start", [("-m", "twin"), ("-P", "-c", "from twin.cli import main; main()")])
def test_packages_of_the_current_folder_do_not_hide_those_of_the_program(tmp_path, start):
    for name in ("controllers", "scenes", "terrains"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('a package of the current folder')")
    command = [sys.executable, *start]
    variables = os.environ | {"PYTHONPATH": str(ROOT)}
    for words, printed in (["plan", "nowhere"], "no such scenario"), (["doctor"], "python"):
        done = subprocess.run([*command, *words], cwd=tmp_path, env=variables, capture_output=True, text=True)
        assert printed in (done.stdout + done.stderr).lower() and "current folder" not in done.stderr
        assert done.returncode == (0 if words == ["doctor"] else 2)
