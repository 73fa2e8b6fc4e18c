"""Link errors and errors of the positioning stages: closed forms, statistics, invariance to rigid motion."""

import dataclasses

import numpy as np
import pytest
from judge_synthetic import link_between, survey

from twin.core import geometry
from twin.core.links import Link, Links
from twin.core.records import Trajectory
from twin.judge.network_errors import compose_chain, link_metrics, stage_metrics

RESULT, _, TRUTH, _ = survey()
KEYS = TRUTH.trajectory.world_from_camera[RESULT.keyframe_rows]
N = len(KEYS)
CHAIN = [(k, k + 1) for k in range(N - 1)]
ROTATION, TRANSLATION = np.array([0.003, 0.0, -0.004]), np.array([0.02, -0.01, 0.02])  # 5 mrad, 3 cm


def with_links(links):
    return dataclasses.replace(RESULT, links=Links(links))


def linked(pairs, error=(0.0,) * 6, **fields):
    """Returns links with the same error each."""
    motion = geometry.exp(np.array(error))
    return [Link(i, j, geometry.inverse(KEYS[i]) @ KEYS[j] @ motion, np.eye(6), 0.8, 200, **fields) for i, j in pairs]


def test_motion_errors_have_a_closed_form():
    rotate, shift = geometry.pose(geometry.so3_exp(ROTATION), np.zeros(3)), geometry.pose(np.eye(3), TRANSLATION)
    links = [
        link._replace(closed_form=link.i_from_j @ rotate, i_from_j=link.i_from_j @ shift) for link in linked([(3, 5)])
    ]
    metrics = link_metrics(with_links(links + linked(CHAIN)), TRUTH)["along"]
    n = len(links) + len(CHAIN)
    assert metrics["count"] == n
    assert metrics["translation_rmse_m"] == pytest.approx(0.03 / np.sqrt(n))
    assert metrics["rotation_rmse_deg"] == pytest.approx(0, abs=1e-6)
    # only one link has a closed form
    assert metrics["closed_form_rotation_rmse_deg"] == pytest.approx(np.rad2deg(5e-3))
    assert metrics["nees_mean"] == pytest.approx(0.03**2 / n)  # covariances are the identity


def test_nees_of_links_with_errors_drawn_from_their_covariance_is_six():
    rng = np.random.default_rng(3)
    pairs = [(i, i + d) for d in (1, 2, 3, 4, 7, 20) for i in range(N - d)]
    metrics = link_metrics(with_links([link_between(KEYS, i, j, rng) for i, j in pairs]), TRUTH)
    for direction in ("along", "across"):
        standard_error = np.sqrt(12 / metrics[direction]["count"])  # chi2 with 6 degrees: variance 12
        assert metrics[direction]["nees_mean"] == pytest.approx(6, abs=4 * standard_error)
        for key in ("rotation_rmse_deg", "translation_rmse_m"):  # log(exp(3 e)) is 3 e
            assert metrics[direction][f"closed_form_{key}"] == pytest.approx(3 * metrics[direction][key], rel=1e-6)


def test_links_to_the_two_preceding_nodes_are_along_for_any_node_spacing():
    for stride in (1, 3):
        pairs = [(stride * i, stride * (i + d)) for d in (1, 2, 3, 9) for i in range(10)]
        metrics = link_metrics(with_links(linked(pairs)), TRUTH)
        assert (metrics["along"]["count"], metrics["across"]["count"]) == (20, 20)


def test_links_replaced_by_frame_to_frame_motion_are_counted_but_not_evaluated():
    bridged = [link._replace(n_points=0) for link in linked(CHAIN[:4], (0, 0, 0, 0.5, 0, 0))]
    metrics = link_metrics(with_links(bridged + linked(CHAIN[4:])), TRUTH)
    assert metrics["bridged"] == 4
    assert metrics["along"]["count"] == N - 1 - 4
    assert metrics["along"]["translation_rmse_m"] == pytest.approx(0, abs=1e-9)


def test_stage_errors_do_not_depend_on_the_world_frame_of_the_estimates():
    transform = geometry.exp(np.array([0.3, -0.2, 1.5, 4.0, -3.0, 2.0]))
    transformed = dataclasses.replace(
        RESULT,
        **{
            name: Trajectory(path.times_s, transform @ path.world_from_camera)
            for name in ("f2f", "online", "final")
            if (path := getattr(RESULT, name))
        },
    )
    for stage, metrics in stage_metrics(RESULT, TRUTH).items():
        assert stage_metrics(transformed, TRUTH)[stage]["ate_rmse_m"] == pytest.approx(metrics["ate_rmse_m"], abs=1e-9)


def test_the_chain_of_true_motions_gives_the_true_path():
    poses = compose_chain(Links(linked(CHAIN)), np.arange(N))
    np.testing.assert_allclose(KEYS[0] @ poses, KEYS, atol=1e-9)
    assert stage_metrics(with_links(linked(CHAIN)), TRUTH)["chain"]["ate_max_m"] == pytest.approx(0, abs=1e-9)


def test_an_error_in_the_chain_affects_all_later_keyframes():
    k = 30
    links = linked([pair for pair in CHAIN if pair[0] != k]) + linked([CHAIN[k]], (0, 0, 0, 0.02, 0, 0))
    metrics = stage_metrics(with_links(links), TRUTH)["chain"]
    assert metrics["ate_max_m"] == pytest.approx(0.02)
    assert metrics["ate_rmse_m"] == pytest.approx(0.02 * np.sqrt((N - 1 - k) / N))


def test_every_stage_is_evaluated_at_the_same_keyframes():
    n = 40
    links = linked(CHAIN[: n - 1])
    metrics = stage_metrics(with_links(links), TRUTH)
    frames = RESULT.keyframe_rows[:n]
    for name in ("f2f", "online", "final"):
        path = getattr(RESULT, name).world_from_camera[frames]
        anchored = KEYS[0] @ geometry.inverse(path[0]) @ path
        error = np.linalg.norm(anchored[:, :3, 3] - KEYS[:n, :3, 3], axis=1)
        assert metrics[name]["ate_rmse_m"] == pytest.approx(np.sqrt(np.mean(error**2)))
        assert metrics[name]["ate_max_m"] == pytest.approx(error.max())


def test_a_chain_with_a_gap_has_no_error():
    gap = [pair for pair in CHAIN if pair != CHAIN[50]]
    links = linked([*gap, (50, 52), (49, 51)])
    assert len(compose_chain(Links(links), np.arange(N))) == 0
    metrics = stage_metrics(with_links(links), TRUTH)
    assert metrics["chain"] == {"ate_rmse_m": None, "ate_max_m": None}
    assert metrics["final"]["ate_rmse_m"] is not None


def test_a_survey_without_links_has_every_key_and_no_values():
    none = with_links([])
    assert link_metrics(none, TRUTH)["along"]["nees_mean"] is None and link_metrics(none, TRUTH)["bridged"] == 0
    assert all(value is None for stage in stage_metrics(none, TRUTH).values() for value in stage.values())
