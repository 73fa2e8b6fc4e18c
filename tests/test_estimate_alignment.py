"""Global alignment against eq. (7) solved directly with Lagrange multipliers, and removal of outlier links."""

from dataclasses import replace

import numpy as np
import pytest

from twin.core import geometry
from twin.core.links import Link
from twin.core.records import Readings, SensorNoise, StereoRig
from twin.estimate import alignment
from twin.estimate.alignment import align
from twin.estimate.vision.stereo import Keyframe
from twin.judge.consistency import nees, nees_interval

RIG = StereoRig(320, 240, 277.0, 0.15, 30.0, geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.zeros(3)))
NOISE = SensorNoise(0.01, 0.003, 0.01)
ANCHOR = {0: np.eye(6) * 1e-16}


def small_network(rng, n=6, share_of_sigma=0.3):
    """Returns poses of a loop and links along and across it; no residual is large enough for a Huber weight below 1."""
    poses = [geometry.exp(np.array([0.05 * k, -0.1 * k, 0.2 * k, 0.5 * k, 0.1 * k * k, 0.02 * k])) for k in range(n)]
    pairs = [(k, k + 1) for k in range(n - 1)] + [(0, 3), (1, 4), (2, 5), (0, 5)]
    links = []
    for i, j in pairs:
        root = rng.normal(size=(6, 6)) * 2e-3
        cov = root @ root.T + np.diag([1e-6] * 6)
        error = np.linalg.cholesky(cov) @ rng.normal(size=6) * share_of_sigma
        links.append(Link(i, j, geometry.inverse(poses[i]) @ poses[j] @ geometry.exp(error), cov, 1.0, 100))
    return poses, links


def keyframes(poses, readings=None):
    readings = readings or [Readings()] * len(poses)
    return [Keyframe(k, k, 1, pose.copy(), None, r) for k, (pose, r) in enumerate(zip(poses, readings, strict=True))]


def numeric(function, at, step=1e-6):
    return np.column_stack([(function(at + d) - function(at - d)) / (2 * step) for d in np.eye(len(at)) * step])


def mixed_adjustment(start, links, iterations=6):
    """Minimises eq. (7) by its bordered system with the first pose fixed.

    Returns:
        Poses (n, 4, 4), and the covariance of poses 1 to n - 1.
    """
    poses, motions = [p.copy() for p in start], [link.i_from_j.copy() for link in links]
    n, m = 6 * (len(poses) - 1), 6 * len(links)
    c_inverse = np.zeros((m, m))
    for k, link in enumerate(links):
        c_inverse[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] = np.linalg.inv(link.cov)

    def constraint(x, v):
        moved = [poses[0]] + [p @ geometry.exp(x[6 * k : 6 * k + 6]) for k, p in enumerate(poses[1:])]
        rows = []
        for k, link in enumerate(links):
            motion = motions[k] @ geometry.exp(v[6 * k : 6 * k + 6])
            rows.append(geometry.log(geometry.inverse(motion) @ geometry.inverse(moved[link.i]) @ moved[link.j]))
        return np.concatenate(rows)

    for _ in range(iterations):
        a = numeric(lambda x: constraint(x, np.zeros(m)), np.zeros(n))
        b = numeric(lambda v: constraint(np.zeros(n), v), np.zeros(m))
        residual = np.concatenate(
            [
                geometry.log(geometry.inverse(link.i_from_j) @ motion)
                for link, motion in zip(links, motions, strict=True)
            ]
        )
        w = constraint(np.zeros(n), np.zeros(m))
        system = np.block(
            [[np.zeros((n, n)), np.zeros((n, m)), a.T], [np.zeros((m, n)), c_inverse, b.T], [a, b, np.zeros((m, m))]]
        )
        right = np.concatenate([np.zeros(n), -c_inverse @ residual, -w])
        solution = np.linalg.solve(system, right)
        poses = [poses[0]] + [p @ geometry.exp(solution[6 * k : 6 * k + 6]) for k, p in enumerate(poses[1:])]
        motions = [q @ geometry.exp(solution[n + 6 * k : n + 6 * k + 6]) for k, q in enumerate(motions)]
    inner = np.linalg.inv(b @ np.linalg.inv(c_inverse) @ b.T)
    return np.array(poses), np.linalg.inv(a.T @ inner @ a)


def test_alignment_agrees_with_eq_7_solved_with_lagrange_multipliers():
    rng = np.random.default_rng(0)
    poses, links = small_network(rng)
    start = [poses[0]] + [p @ geometry.exp(rng.normal(size=6) * 0.02) for p in poses[1:]]
    direct, cov = mixed_adjustment(start, links)
    aligned = align(keyframes(start), links, ANCHOR, RIG, NOISE)
    # the bordered system adds residuals as vectors, a relative error of 5e-4 at 1e-3 rad: 3e-6 m at 5 m
    np.testing.assert_allclose(aligned.poses, direct, atol=5e-6)
    for k in range(1, len(poses)):
        block = cov[6 * k - 6 : 6 * k, 6 * k - 6 : 6 * k]
        np.testing.assert_allclose(aligned.covs[k], block, atol=0.02 * np.abs(block).max())


def test_exact_links_give_the_true_poses():
    poses, links = small_network(np.random.default_rng(1), share_of_sigma=0.0)
    start = [poses[0]] + [p @ geometry.exp(np.full(6, 0.05)) for p in poses[1:]]
    aligned = align(keyframes(start), links, ANCHOR, RIG, NOISE)
    np.testing.assert_allclose(aligned.poses, poses, atol=1e-6)
    assert not aligned.dropped


def test_an_alignment_that_ends_before_it_converges_says_so(monkeypatch):
    poses, links = small_network(np.random.default_rng(1))
    start = [poses[0]] + [p @ geometry.exp(np.full(6, 0.5)) for p in poses[1:]]
    assert align(keyframes(start), links, ANCHOR, RIG, NOISE).converged is True
    for name, limit in {"_ROUND_ITERATIONS": 1, "_MAX_ITERATIONS": 1, "_MAX_ROUNDS": 0}.items():
        monkeypatch.setattr(alignment, name, limit)
    assert align(keyframes(start), links, ANCHOR, RIG, NOISE).converged is False


def test_an_outlier_link_is_removed_and_reported():
    poses, links = small_network(np.random.default_rng(2))
    outlier = links[6]._replace(i_from_j=links[6].i_from_j @ geometry.exp(np.array([0, 0, 0.2, 0.5, 0, 0])))
    aligned = align(keyframes(poses), links[:6] + [outlier] + links[7:], ANCHOR, RIG, NOISE)
    assert [(link.i, link.j) for link in aligned.dropped] == [(outlier.i, outlier.j)]
    np.testing.assert_allclose(
        aligned.poses, align(keyframes(poses), links[:6] + links[7:], ANCHOR, RIG, NOISE).poses, atol=1e-5
    )


def test_pressure_and_attitude_bound_the_drift_of_a_chain():
    """A chain of 40 links with a rotation bias of 2 mrad per link."""
    n = 40
    step = geometry.exp(np.array([0, 0, 0, 0, -0.3, 0.0]))
    start_pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 2.0]))
    true = [start_pose]
    for _ in range(n - 1):
        true.append(true[-1] @ step)
    bias = geometry.exp(np.array([0.002, 0, 0, 0, 0, 0]))
    cov = np.diag([0.002**2] * 3 + [0.001**2] * 3)
    links = [Link(k, k + 1, step @ bias, cov, 1.0, 100) for k in range(n - 1)]
    unaided = align(keyframes(true), links, ANCHOR, RIG, NOISE).poses[-1]
    level = Readings(2.0, np.zeros(3))
    aided = align(keyframes(true, [level] * n), links, ANCHOR, RIG, NOISE).poses[-1]
    assert abs(unaided[2, 3] - 2.0) > 0.3
    assert abs(aided[2, 3] - 2.0) < 0.01


@pytest.mark.parametrize("stride", [1, 2])
def test_links_between_consecutive_nodes_are_never_removed(stride):
    """An outlier among them contradicts its neighbours, but without it the network may be disconnected.

    With a stride of 2, every second keyframe is a node, so consecutive nodes have the numbers 0, 2, 4.
    """
    poses, links = small_network(np.random.default_rng(3))
    links[2] = links[2]._replace(i_from_j=links[2].i_from_j @ geometry.exp(np.array([0, 0, 0, 0.3, 0, 0])))
    links = [link._replace(i=stride * link.i, j=stride * link.j) for link in links]
    nodes = [replace(node, number=stride * node.number) for node in keyframes(poses)]
    aligned = align(nodes, links, ANCHOR, RIG, NOISE)
    assert all(link.j - link.i > stride for link in aligned.dropped)


def test_the_covariance_of_a_node_with_height_and_attitude_readings_is_that_of_their_noise():
    """The attitude covariance is compared with finite differences of the angles; east and north are unconstrained."""
    body = np.array([0.1, -0.2, 0.7])

    def camera(rpy):
        return geometry.rotation_from_rpy(*map(float, rpy)) @ RIG.body_from_camera[:3, :3]

    pose, wide = geometry.pose(camera(body), np.array([1.0, 2.0, 3.0])), {0: np.eye(6) * 1e2}
    cov = align(keyframes([pose], [Readings(3.0, body)]), [], wide, RIG, NOISE).covs[0]
    np.testing.assert_allclose(pose[2, :3] @ cov[3:, 3:] @ pose[2, :3], NOISE.pressure_m**2, rtol=1e-3)
    rotations = [geometry.so3_exp(step) for step in np.eye(3) * 1e-6]  # about the axes of the body, as in data sheets
    in_camera = [geometry.so3_log(camera(body).T @ geometry.rotation_from_rpy(*body) @ r @ RIG.body_from_camera[:3, :3])
                 / 1e-6 for r in rotations]  # fmt: skip
    by_body = np.column_stack(in_camera)
    sigma = np.diag(NOISE.attitude_sigmas_rad)
    np.testing.assert_allclose(cov[:3, :3], by_body @ sigma**2 @ by_body.T, rtol=1e-3, atol=1e-9)


def test_gross_outliers_are_removed_and_at_most_1_percent_of_the_inliers():
    """Parallel legs where one link in four is an outlier."""
    rng, rows, cols = np.random.default_rng(4), 8, 30
    poses = [geometry.pose(np.eye(3), np.array([0.25 * c, 0.6 * r, 0.0])) for r in range(rows) for c in range(cols)]
    steps = [1, 2, 6, cols, cols + 1, 2 * cols]
    pairs = [(k, k + step) for step in steps for k in range(len(poses) - step)]
    cov, links, outliers = np.diag([1e-8] * 3 + [1e-7] * 3), [], set()
    for i, j in pairs:
        error = np.sqrt(np.diag(cov)) * rng.standard_normal(6)
        if j - i > 1 and rng.random() < 0.3:
            error += 0.3 * rng.standard_normal(6)
            outliers.add((i, j))
        links.append(Link(i, j, geometry.inverse(poses[i]) @ poses[j] @ geometry.exp(error), cov, 1.0, 100))
    start = [pose @ geometry.exp(2e-3 * rng.standard_normal(6)) for pose in poses]
    aligned = align(keyframes([poses[0], *start[1:]]), links, ANCHOR, RIG, NOISE)
    dropped = {(link.i, link.j) for link in aligned.dropped}
    assert outliers <= dropped
    assert len(dropped - outliers) <= 0.01 * len(links)
    errors_m = np.linalg.norm([a[:3, 3] - b[:3, 3] for a, b in zip(aligned.poses, poses, strict=True)], axis=1)
    assert errors_m.max() < 3e-3


@pytest.mark.long
def test_the_number_of_independent_errors_predicts_how_much_the_mean_nees_of_surveys_varies():
    """400 surveys of the same network with other noise: the variance of the mean NEES has a standard error of 10 %."""
    means, independent = [], 0.0
    for seed in range(400):
        poses, links = small_network(np.random.default_rng(5), share_of_sigma=0)
        rng = np.random.default_rng(seed)
        noisy = [
            link._replace(i_from_j=link.i_from_j @ geometry.exp(np.linalg.cholesky(link.cov) @ rng.normal(size=6)))
            for link in links
        ]
        aligned = align(keyframes(poses), noisy, ANCHOR, RIG, NOISE)
        error = np.array([geometry.inverse(t) @ f for t, f in zip(poses[1:], aligned.poses[1:], strict=True)])[:, :3, 3]
        means.append(nees(error, aligned.covs[1:, 3:, 3:]).mean())
        independent = aligned.independent_errors or independent
    assert np.mean(means) == pytest.approx(3, abs=4 * np.sqrt(6 / independent / 400))
    assert 6 / np.var(means) == pytest.approx(independent, rel=0.4)
    assert 1 < independent < len(poses) - 1
    low, high = nees_interval(independent) or (0.0, 0.0)
    assert np.mean((np.array(means) < low) | (np.array(means) > high)) < 0.03


def test_independent_and_common_errors_are_counted_exactly():
    rng, covs = np.random.default_rng(0), np.tile(np.diag([1.0, 4.0, 9.0]), (20, 1, 1))
    single = rng.normal(size=(20, 3, 20000)) * np.array([1, 2, 3])[:, None]
    assert alignment._independent_errors([single], covs) == pytest.approx(20, rel=0.04)
    assert alignment._independent_errors([np.repeat(single[:1], 20, axis=0)], covs) == pytest.approx(1, rel=0.04)
    assert alignment._independent_errors([single], 0 * covs) is None
