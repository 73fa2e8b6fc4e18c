"""`twin compare`: the table, its differences, the page and the runs that cannot be compared."""

import json

import numpy as np
import pytest

from twin.core.records import Trajectory
from twin.errors import TwinError
from twin.judge.metrics import empty_metrics
from twin.report import run_comparison


def write_run(folder, error_m, completeness, **scenario):
    """Writes a run folder whose estimates are off by a constant sideways error after the first frame."""
    folder.mkdir(parents=True)
    lines = [f"{key} = {json.dumps(value)}" for key, value in scenario.items()]
    (folder / "scenario.resolved.toml").write_text("\n".join(['name = "test"', *lines]) + "\n")
    metrics = empty_metrics() | {"name": "test", "seed": 1, "version": "0", "scenario_hash": "0"}
    metrics |= {"status": "complete", "reason": "", "idealisations": [], "warnings": []}
    metrics["trajectory"]["final"]["ate_rmse_m"] = error_m
    metrics["map"]["completeness"] = completeness
    (folder / "metrics.json").write_text(json.dumps(metrics))
    poses = np.tile(np.eye(4), (20, 1, 1))
    poses[:, 0, 3] = 0.1 * np.arange(20)
    Trajectory(np.arange(20.0), poses).save(folder / "trajectory_truth.tum")
    poses[1:, 1, 3] = error_m
    for name in ("online", "final"):
        Trajectory(np.arange(20.0), poses).save(folder / f"trajectory_{name}.tum")
    return folder


@pytest.fixture
def runs(tmp_path):
    first = write_run(tmp_path / "a" / "run", 0.002, 0.9, seed=1)
    second = write_run(tmp_path / "b" / "run", 0.003, 0.95, seed=2)
    third = write_run(tmp_path / "b" / "worse", 0.02, None, seed=1)
    return run_comparison.load_runs([first, second, third])


def row(runs, name):
    return next(row for row in run_comparison.table(runs) if row.name == name).cells


def test_differences_are_those_from_the_first_run_and_better_is_told_from_worse(runs):
    first, second, third = row(runs, "trajectory.final.ate_rmse_m")
    assert (first.text, first.change, first.difference, first.level) == ("2.0 mm", "", None, "")
    assert (second.text, second.change, second.level) == ("3.0 mm", "+1.0 mm (+50 %)", "bad")
    assert second.difference == pytest.approx(0.001)
    assert third.change == "+1.8 cm (10 \N{MULTIPLICATION SIGN})"
    first, second, third = row(runs, "map.completeness")
    assert (second.change, second.level) == ("+5 %", "good")
    assert (third.value, third.difference, third.level) == (None, None, "")


def test_a_difference_below_one_percent_is_neither_good_nor_bad(tmp_path):
    first = write_run(tmp_path / "one", 0.002, 0.9, seed=1)
    second = write_run(tmp_path / "two", 0.002 * 1.009, 0.909, seed=1)
    runs = run_comparison.load_runs([first, second])
    for name in ("trajectory.final.ate_rmse_m", "map.completeness"):
        changed = row(runs, name)[1]
        assert changed.change not in ("", "same") and changed.level == ""


def test_a_quantity_that_no_run_has_is_left_out(runs):
    assert "map.le90_m" not in [row.name for row in run_comparison.table(runs)]


def test_runs_of_equal_folder_names_are_told_apart(runs):
    assert run_comparison.names_of(runs) == ["a/run", "b/run", "b/worse"]
    assert run_comparison.names_of(runs[1:]) == ["run", "worse"]


def test_the_json_has_values_differences_and_what_the_scenarios_differ_in(runs):
    tree = json.loads(json.dumps(run_comparison.as_json(runs)))
    assert [run["status"] for run in tree["runs"]] == ["complete"] * 3
    assert tree["metrics"]["trajectory.final.ate_rmse_m"]["values"] == [0.002, 0.003, 0.02]
    assert tree["metrics"]["map.completeness"]["differences"] == [None, pytest.approx(0.05), None]
    assert tree["scenario"] == {"seed": ["1", "2", "1"]}


def test_the_page_names_every_run_draws_the_curves_and_warns_of_different_floors(runs):
    page = run_comparison.render(runs)
    for text in (
        "a/run",
        "b/worse",
        "+1.0 mm (+50 %)",
        "b/run compared with a/run: position error (RMSE) 3.0 mm instead of 2.0 mm, worse; mapped part",
        "different floors or plans: seed.",
        "partly due to chance, and to the floors or plans, which differ",
        "Differences of the scenar",
    ):
        assert text in page
    assert page.count("data:image/png;base64,") == 2  # position errors and paths; the runs have no maps
    same = run_comparison.render([runs[0], runs[2]])
    assert "different floors" not in same and "Differences of the scenarios" not in same


def test_runs_whose_objects_differ_say_so_in_words(tmp_path):
    runs = [write_run(tmp_path / name, 0.002, 0.9) for name in ("first", "second")]
    for run, growth_m in zip(runs, (0.0, 0.05), strict=True):
        entries = [f"[[objects]]\ncolour = [0.1, 0.2, 0.3]\nsize_m = 0.4\ngrowth_m = {g}\n" for g in (0.0, growth_m)]
        with (run / "scenario.resolved.toml").open("a") as file:
            file.write("".join(entries))
    loaded = run_comparison.load_runs(runs)
    assert run_comparison.scenario_differences(loaded) == {"objects.1.growth_m": ["0.0", "0.05"]}
    page = run_comparison.render(loaded)
    assert "surveys of different floors or plans: growth (objects entry 2)." in page
    assert "<li>growth (objects entry 2): first 0.0, second 0.05</li>" in page


def test_runs_without_truth_are_compared_by_their_paths_alone(runs):
    for run in runs[:2]:
        (run.folder / "trajectory_truth.tum").unlink()
    page = run_comparison.render(run_comparison.load_runs([run.folder for run in runs[:2]]))
    assert page.count("data:image/png;base64,") == 1  # paths; there are no errors


def test_runs_that_cannot_be_compared_are_refused(tmp_path, runs):
    folder = runs[0].folder
    with pytest.raises(TwinError, match="RUN: 1 runs .allowed: 2 to 8"):
        run_comparison.load_runs([folder])
    with pytest.raises(TwinError, match="the same folder is given twice"):
        run_comparison.load_runs([folder, folder / ".." / "run"])
    with pytest.raises(TwinError, match="is not a run folder"):
        run_comparison.load_runs([folder, tmp_path])
    (folder / "metrics.json").unlink()
    with pytest.raises(TwinError, match="the survey is unfinished"):
        run_comparison.load_runs([folder, runs[1].folder])


def test_scenarios_that_differ_late_in_a_long_list_differ(tmp_path):
    runs = [write_run(tmp_path / name, 0.002, 0.9) for name in ("first", "second")]
    for run, last in zip(runs, ("9.0", "9.5"), strict=True):
        with (run / "scenario.resolved.toml").open("a") as file:
            file.write(f"[other]\noutline_m = [{'0.123456789, ' * 12}{last}]\n")
    differences = run_comparison.scenario_differences(run_comparison.load_runs(runs))
    assert list(differences) == ["other.outline_m"] and all(len(text) == 80 for text in differences["other.outline_m"])


def test_an_error_that_holes_make_infinite_is_worse_than_any_other(tmp_path):
    folders = [write_run(tmp_path / name, 0.002, 0.9, seed=1) for name in ("whole", "holes", "more")]
    for folder, le90_m, covered, frames in zip(
        folders, (0.01, None, None), (0.95, 0.6, 0.4), (12340, 12345, 1), strict=True
    ):
        metrics = json.loads((folder / "metrics.json").read_text())
        metrics["map"] |= {"le90_area_m": le90_m, "completeness_area": covered}
        metrics["timing"]["frames"] = frames
        (folder / "metrics.json").write_text(json.dumps(metrics))
    whole, holes, more = run_comparison.load_runs(folders)
    first, second = row([whole, holes], "map.le90_area_m")
    assert (second.text, second.change, second.level, second.value) == ("infinite (holes)", "worse", "bad", None)
    first, second = row([holes, whole], "map.le90_area_m")
    assert (second.text, second.change, second.level) == ("1.0 cm", "better", "good")
    assert row([holes, more], "map.le90_area_m")[1].change == "same"
    assert [cell.text for cell in row([whole, holes], "timing.frames")] == ["12340", "12345"]
    text = json.dumps(run_comparison.as_json([whole, holes]), allow_nan=False)
    assert "infinite" not in text and "of the asked area" in run_comparison.render([whole, holes])
