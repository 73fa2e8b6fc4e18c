"""Error curves of a run have the alignment of its metrics."""

from dataclasses import replace

import numpy as np
import pytest
from judge_synthetic import SCENARIO, write_folder

from twin.core import geometry
from twin.core.records import Trajectory
from twin.errors import TwinError
from twin.judge.recorded import recorded_errors
from twin.judge.trajectory_errors import path_errors
from twin.report import headline, recording, run_comparison, stage_tables, survey_figures
from twin.report.headline import REPLAY_ALIGNMENTS
from twin.report.run_folder import load_run
from twin.report.survey_page import context


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """Returns a survey whose first final pose has an error, as that of an estimate with an alignment by se3."""
    found = load_run(write_folder(tmp_path_factory.mktemp("errors") / "run"))
    final = found.trajectories["final"]
    poses = final.world_from_camera.copy()
    poses[0] = poses[0] @ geometry.exp(np.array([0, 0, 0.02, 0.05, 0, 0]))
    return replace(found, trajectories=found.trajectories | {"final": Trajectory(final.times_s, poses)})


def of_replay(run, alignment):
    return replace(run, metrics=run.metrics | {"replay": {"alignment": alignment}})


@pytest.mark.parametrize("alignment", ["se3", "none"])
def test_the_curves_of_a_replay_have_its_alignment(run, alignment, monkeypatch):
    final, truth = run.trajectories["final"], run.trajectories["truth"]
    aligned = recorded_errors(final, truth, alignment).distance_m
    anchored = path_errors(final, truth).distance_m
    assert np.abs(aligned - anchored).max() > 0.01
    replayed = of_replay(run, alignment)
    logged = {}
    monkeypatch.setattr(
        recording, "log_curve", lambda _, run, entity, frames, values, *role: logged.update({entity: values})
    )
    recording.log_curves(recording.rr.RecordingStream("test"), replayed, SCENARIO.believed_rig())
    curves = [
        survey_figures.path_error_curves(replayed).axes[0].lines[-1].get_ydata(),
        run_comparison.error_curves([(replayed, {})]).axes[1].lines[-1].get_ydata(),
        logged["error/position/final"],
    ]
    for curve in curves:
        np.testing.assert_allclose(curve, aligned, atol=1e-12)


@pytest.mark.parametrize("alignment", [None, "first", "unheard of"])
def test_other_curves_are_anchored_at_the_first_true_pose(run, alignment):
    expected = path_errors(run.trajectories["final"], run.trajectories["truth"])
    for one in (run, of_replay(run, alignment)):
        np.testing.assert_allclose(one.errors("final").distance_m, expected.distance_m, atol=1e-12)


@pytest.mark.long
def test_the_page_states_the_alignment_of_the_curves(run):
    assert context(run)["alignment"] == "anchored at the first true pose"
    replayed = replace(run, metrics=run.metrics | {"replay": {"alignment": "none"}})
    assert context(replayed)["alignment"] == REPLAY_ALIGNMENTS["none"]


@pytest.mark.parametrize("row", ["0.1 nan 0 0 0 0 0 1", "nan 0 0 0 0 0 0 1", "0.1 0 0", "# nothing else"])
def test_a_trajectory_without_numbers_is_refused(tmp_path, row):
    folder = write_folder(tmp_path / "run")
    (folder / "trajectory_final.tum").write_text(row + "\n")
    with pytest.raises(TwinError, match="trajectory_final.tum"):
        load_run(folder)


def test_unknown_stages_and_sources_of_an_edited_run_are_shown(run):
    timing = {"stages": {"other": {"count": 1}}, "keyframes": 0}
    assert stage_tables.stage_times({"timing": timing}, {}, None)[0].mean_ms is None
    assert headline.conditions({"water": {"source": "other"}}, 3.0)
