"""Odd scenarios, command lines and edited run folders end in a message and exit status 2 or work, never in a traceback.

`python tests/hostile_scenarios.py 2000` is the long form of the first test.
"""

import json
import re
import shutil
import sys
import time
from pathlib import Path

import pytest
from hostile_scenarios import LOOSE, ODD, attempt, draw, mutations, write_case, write_inline
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from judge_synthetic import write_folder

from twin import cli
from twin.app import outputs
from twin.errors import ScenarioError, TwinError
from twin.report.run_folder import load_run
from twin.report.survey_page import write_report
from twin.scenario.file import load_scenario
from twin.studies.study_file import load_study
from twin.world import planning

LIMIT_S = 15.0


@pytest.mark.long
@settings(max_examples=25, derandomize=True, database=None, deadline=None, suppress_health_check=list(HealthCheck))
@given(mutations(), st.sampled_from((write_case, write_inline)))
def test_a_mutated_scenario_is_accepted_or_refused(tmp_path_factory, changes, write):
    start = time.process_time()
    attempt(*write(tmp_path_factory.mktemp("case"), changes))
    assert time.process_time() - start < LIMIT_S


@pytest.mark.parametrize("line", LOOSE, ids=[line[:20] + f"_{len(line)}" for line in LOOSE])
def test_an_odd_line_is_refused_with_the_file_and_a_line(tmp_path, line):
    file, _ = write_case(tmp_path, [("", line)])
    assert re.match(r"refused: \S*(scenario|link)\.toml:\d+: ", attempt(file, []))


@pytest.mark.parametrize("value", ODD, ids=[value[:20] + f"_{len(value)}" for value in ODD])
def test_an_odd_value_is_refused_in_a_message_of_one_screen(tmp_path, value):
    file, _ = write_case(tmp_path, [])
    for key in ("plan.speed_mps", "terrain.size_m", "lamps", "navigation.aiding", "seed", "imaging.fidelity"):
        if key == "seed" and value in ("0", "1", "2", "123456789123456789", "1e9", "1e5"):
            continue
        try:
            load_scenario(file, [f"{key}={value}"])
        except ScenarioError as error:
            assert len(str(error)) < 3000
            assert "--set" in str(error)


def test_the_cases_of_a_campaign_are_the_same_at_every_call():
    assert draw(50) == draw(50) and draw(50) != draw(50, seed=1)


@pytest.mark.parametrize(
    ("overrides", "field"),
    [
        (["plan.area_m=[1e5,1e5]", "terrain.size_m=[1e5,1e5]"], "terrain.grid_m"),
        (["plan.overlap_across=0.999999999"], "plan.overlap_across"),
        (["plan.area_m=[1e-9,1e-9]"], "plan.area_m"),
        (["plan.speed_mps=0.011", "plan.area_m=[5.0,4.0]", "rig.frame_rate_hz=120", "plan.overlap_across=0.999"],
         "plan.area_m"),
        (["map.cell_m=0.0011", "plan.altitude_m=20.0"], "map.cell_m"),
    ],
)  # fmt: skip
def test_a_size_beyond_its_limit_is_refused_before_anything_is_allocated(tmp_path, overrides, field):
    file, _ = write_case(tmp_path, [])
    outcome = attempt(file, overrides)
    assert f"{field}: " in outcome and "up to" in outcome or "at least" in outcome or "at most" in outcome, outcome


def test_the_limits_are_stated_with_the_number_and_the_remedy(tmp_path):
    file, _ = write_case(tmp_path, [])
    outcome = attempt(file, ["map.cell_m=0.0011", "plan.altitude_m=20.0"])
    assert f"cells of the map are too many (allowed: up to {planning.MAX_MAP_CELLS}: a cell of" in outcome


def test_a_study_of_too_many_surveys_is_refused(tmp_path):
    file = tmp_path / "big.toml"
    file.write_text(
        'scenario = "reef"\n[vary]\n"plan.altitude_m" = { uniform = [1.0, 2.0] }\n[sampling]\nsamples = 10_000_000\n'
    )
    with pytest.raises(ScenarioError, match=r"sampling: 10000000 surveys are too many \(allowed: up to 100000"):
        load_study(file)


@pytest.fixture
def command(monkeypatch, tmp_path, capsys):
    """Runs the command line in an empty folder; returns (exit status, stdout, stderr). Other exceptions are raised."""
    monkeypatch.chdir(tmp_path)

    def run(*words):
        monkeypatch.setattr(sys, "argv", ["twin", *words])
        with pytest.raises(SystemExit) as end:
            cli.main()
        return end.value.code or 0, *capsys.readouterr()

    return run


SMALL = ["--set", "terrain.kind=flat", "--set", "terrain.texture_px_m=0.05", "--set", "plan.tracks=1"]
ODD_NAMES = ("", "a\0b", "n" * 300)
ODD_PATHS = ("file/below", "a\0b", "n" * 300, "d/" * 3000 + "x", "folder", "loop/x", "/proc/nowhere/x")


@pytest.mark.parametrize("out", ODD_PATHS, ids=[path[:12] for path in ODD_PATHS])
@pytest.mark.parametrize(
    "words",
    [
        ["plan", "reef", *SMALL],
        ["look", "reef", *SMALL],
        ["run", "reef"],
        ["demo"],
        ["study", "turbidity"],
        ["tune", "overlap"],
        ["fit-surrogate"],
        ["reproduce", "turbidity"],
    ],
    ids=lambda words: words[0],
)
def test_an_output_that_cannot_be_written_is_refused_before_work_begins(command, tmp_path, words, out):
    (tmp_path / "file").touch()
    (tmp_path / "folder" / "full.png").mkdir(parents=True)
    (tmp_path / "loop").symlink_to(tmp_path / "loop")
    if out == "folder":
        if words[0] == "reproduce":
            pytest.skip("turbidity.png is written into an existing folder")
        out = "folder" if words[0] in ("run", "demo", "study", "tune") else "folder/full.png"
    status, _, err = command(*words, "--out", out)
    assert status == 2 and ("--out: " in err or "embedded null" in err), err
    assert len(err) < 1000


@pytest.mark.parametrize(
    "words",
    [
        *(
            [name, path]
            for name in ("report", "view", "plan", "run", "look", "study")
            for path in ("", "a\0b", "n" * 300)
        ),
        *(["run", "reef", "--set", text] for text in ("", "=", "=1", "a", ".=1", "a..b=1", "plan=", "plan.tracks")),
        *(["plan", "reef", "--set", f"lamps.{item}.tilt_deg=1"] for item in ("-1", "99", "x", "9" * 50, "")),
        ["plan", "reef", "--set", "seed=" + "9" * 5000],
        ["plan", "reef", "--set", "plan.tracks=1000000000"],
        ["plan", "reef", "--set", "a" + ".a" * 5000 + "=1"],
        ["plan", "reef", "--set", "seed=" + "[" * 5000],
        *(["run", "reef", "--seed", seed] for seed in ("-1", "x", "1e3", "9" * 5000, str(2**32), "")),
        *(["look", "reef", "--at", at] for at in ("", "1,2", "a,b,c", "nan,0,1", "1e400,0,1")),
        *(["study", "turbidity", "--jobs", jobs] for jobs in ("0", "-1", "x", "9" * 30)),
        ["study", "turbidity", "--scheduler", "nowhere"],
    ],
    ids=lambda words: " ".join(words)[:40].replace("\0", "0"),
)
def test_an_odd_command_line_is_refused(command, words):
    status, _, err = command(*words)
    assert status == 2 and err and "Traceback" not in err
    assert len(err) < 4000


@pytest.mark.parametrize("name", ["[/x]", "$\\frac$x_{", "../x", "\0", "\x1b[31m", "é" * 80])
def test_a_plan_of_any_name_is_printed_and_drawn_literally(command, tmp_path, name):
    (tmp_path / "odd.toml").write_text(f'extends = "{Path(cli.__file__).parent.parent}/scenes/reef.toml"\n')
    text = json.dumps(name, ensure_ascii=False).replace("\0", "\\u0000").replace("\x1b", "\\u001b")
    status, out, err = command("plan", "odd.toml", *SMALL, "--set", f"name={text}")
    assert status == 0, err
    if name.isprintable() and len(name) < 20:
        assert f"Plan of {name}" in out
    assert len(list((tmp_path / "runs").glob("*.png"))) == 1


def test_the_name_of_a_file_contains_no_separator_and_at_most_100_bytes():
    assert outputs.file_stem("a/b\0c") == "a_b_c"
    assert outputs.file_stem("é" * 80) == "é" * 50


def test_a_bug_still_shows_its_traceback(command, monkeypatch):
    monkeypatch.setattr("twin.planning.summary.summarise", lambda _: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        command("plan", "reef", *SMALL, "--out", "x.png")


@pytest.fixture(scope="module")
def run_folder(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("runs") / "run")


EDITS = [
    *(("metrics.json", None, text) for text in ("[]", "3", '"x"', "null", "{}", "[" * 100_000, "9" * 5000, "\0")),
    *(("env.json", None, text) for text in ("[1]", "3", '"x"', "[" * 100_000)),
    *(("keyframes/index.json", None, text) for text in ("[1]", "3", '"x"', '{"frames": {}}', '{"frames": [1]}')),
    *(
        ("metrics.json", key, value)
        for key in ("map", "map.le90_m", "trajectory", "trajectory.final.path_m", "tracks", "tracks.0.track", "timing",
                    "timing.stages", "timing.stages.f2f", "links", "status", "name", "require", "stages", "overlap")
        for value in ("x", 3.5, [1], {"a": {}}, True, float("nan"), 10**400, 1e300, "DELETED")
    ),
    *(
        ("keyframes/index.json", key, value)
        for key in ("frames", "tracks", "n_frames_per_keyframe", "timing_ms", "timing_ms.f2f", "stereo_observations")
        for value in ("x", 3.5, [-1], [1.5], [10**30], {"a": {}}, True, [{"row": 1}], "DELETED")
    ),
]  # fmt: skip


def edited(text, key, value):
    """Returns the JSON text with the value at a dotted key replaced, or the key removed."""
    tree = json.loads(text)
    *parents, leaf = key.split(".")
    node = tree
    for part in parents:
        node = node[int(part) if isinstance(node, list) else part]
    if value == "DELETED":
        node.pop(leaf, None)
    else:
        node[leaf] = value
    return json.dumps(tree)


@pytest.mark.long
def test_an_edited_run_folder_is_read_or_refused_with_the_name_of_its_file(run_folder):
    refused = 0
    for name, key, value in EDITS:
        file = run_folder / name
        original = file.read_text()
        try:
            file.write_text(value if key is None else edited(original, key, value))
            load_run(run_folder)
        except TwinError as error:
            refused += 1
            assert error.field == str(file) and len(str(error)) < 1000
        finally:
            file.write_text(original)
    assert len(EDITS) > refused > len(EDITS) / 2


@pytest.fixture
def report_of(run_folder, tmp_path):
    """Returns a function that gives the report of a copy of the run folder with edits (file, key, value)."""

    def page(*edits):
        shutil.copytree(run_folder, tmp_path / "run")
        for name, key, value in edits:
            file = tmp_path / "run" / name
            file.write_text(edited(file.read_text(), key, value))
        return write_report(tmp_path / "run").read_text()

    return page


@pytest.mark.long
def test_the_report_shows_odd_texts_literally(report_of):
    page = report_of(
        ("metrics.json", "name", "<script>$\\frac[/x]"),
        ("metrics.json", "status", "[/x]<b>"),
        ("env.json", "<b>", {"a": [1]}),
    )
    for text in ("<script>$", "[/x]<b>", "<td><b>"):
        assert text not in page and text.replace("<", "&lt;").replace(">", "&gt;").removeprefix("&lt;td&gt;") in page


@pytest.mark.long
@pytest.mark.parametrize(("name", "key"), [("metrics.json", "map"), ("keyframes/index.json", "frames")])
def test_the_report_of_a_run_without_a_part_is_written_or_refused(report_of, tmp_path, name, key):
    try:
        report_of((name, key, "DELETED"))
    except TwinError as error:
        assert error.field == str(tmp_path / "run" / name)
