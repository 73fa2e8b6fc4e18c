"""The alignment's core on public pose graphs against gtsam's optimum, and its parts against closed forms."""

import os
from pathlib import Path

import gtsam
import numpy as np
import pytest
from evo.core.metrics import APE, PoseRelation
from evo.core.trajectory import PosePath3D

from twin import geometry
from twin.estimate import pose_graph
from twin.exchange import posegraph
from twin.records import Link

DATA = Path(os.environ.get("TWIN_DATA", "../shared/data"))


def public(name):
    if not (DATA / name).is_file():
        pytest.skip(f"no ../shared/data (or TWIN_DATA): {name} is not shipped")
    return posegraph.read(DATA / name).links


def per_quaternion(link):
    """The same link with its information on rotation read as that on the vector part of a quaternion, half an angle."""
    scale = np.diag([0.5] * 3 + [1.0] * 3)
    return link._replace(cov=scale @ link.cov @ scale)


def ring(rng, n=12, sigma=0.02, share_of_sigma=1.0):
    """Poses around a ring and links with that noise; all they have in common is the loop."""
    poses = [geometry.exp(np.array([0, 0, 2 * np.pi * k / n, 0, 0, 0.0])) for k in range(n)]
    for k, pose in enumerate(poses):
        pose[:3, 3] = [np.cos(2 * np.pi * k / n), np.sin(2 * np.pi * k / n), 0.1 * k]
    pairs = [(k, k + 1) for k in range(n - 1)] + [(0, n - 1), (0, n // 2), (2, n - 3)]
    cov = np.eye(6) * sigma**2
    links = [
        Link(i, j, geometry.inverse(poses[i]) @ poses[j] @ geometry.exp(error * sigma), cov, 1.0, 9)
        for (i, j), error in zip(pairs, share_of_sigma * rng.normal(size=(len(pairs), 6)), strict=True)
    ]
    return poses, links


def gtsam_on_its_own(links):
    """gtsam's optimum of the same graph, built here and run to the last digit."""
    graph = gtsam.NonlinearFactorGraph()
    for link in links:
        noise = gtsam.noiseModel.Gaussian.Information(np.linalg.inv(link.cov))
        graph.add(gtsam.BetweenFactorPose3(link.i, link.j, gtsam.Pose3(link.i_from_j), noise))
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    parameters = gtsam.LevenbergMarquardtParams()
    parameters.setRelativeErrorTol(1e-12)
    start = gtsam.InitializePose3.initialize(graph)
    return graph.error(gtsam.LevenbergMarquardtOptimizer(graph, start, parameters).optimize())


def test_the_small_grid_reaches_gtsams_optimum():
    links = public("smallGrid3D.g2o")
    assert pose_graph.solve(links).cost == pytest.approx(517.93, rel=1e-4)


def test_the_sphere_reaches_gtsams_optimum_and_the_truth():
    links = public("sphere2500.txt")
    solved = pose_graph.solve(links)
    assert solved.cost == pytest.approx(gtsam_on_its_own(links), rel=1e-5)
    assert truth_error_m(solved.poses) <= 0.21


def test_the_sphere_read_per_quaternion_component_costs_what_is_asked():
    solved = pose_graph.solve([per_quaternion(link) for link in public("sphere2500.txt")])
    assert solved.cost == pytest.approx(675.70, rel=1e-3)  # it is 676.26, 0.08 % above
    assert truth_error_m(solved.poses) <= 0.21


def truth_error_m(poses):
    """RMSE of the positions after a rigid alignment, by evo."""
    true = [np.eye(4)]
    for link in public("sphere2500_groundtruth.txt"):
        if link.j == link.i + 1:
            true.append(true[-1] @ link.i_from_j)
    reference, found = (
        PosePath3D(poses_se3=true),
        PosePath3D(poses_se3=[geometry.rigid(poses[k]) for k in sorted(poses)]),
    )
    found.align(reference)
    error = APE(PoseRelation.translation_part)
    error.process_data((reference, found))
    return error.get_all_statistics()["rmse"]


def test_the_chordal_start_needs_no_poses():
    """Without noise it is the answer; with noise it leads to the same minimum as the true poses."""
    poses, exact = ring(np.random.default_rng(0), share_of_sigma=0.0)
    start = pose_graph.chordal_start(exact)
    zero = geometry.inverse(poses[0])
    for k, pose in enumerate(poses):
        np.testing.assert_allclose(start.atPose3(k).matrix(), zero @ pose, atol=1e-6)
    poses, links = ring(np.random.default_rng(1))
    by_chords, by_truth = (pose_graph.solve(links, start) for start in (None, dict(enumerate(poses))))
    assert by_chords.cost == pytest.approx(by_truth.cost, abs=1e-3)


def test_the_chordal_start_is_not_led_astray_by_odometry():
    """Each step of the ring turns 0.3 rad wrong, other links are exact: poses put end to end lose their way."""
    rng = np.random.default_rng(6)
    poses, exact = ring(rng, n=24, share_of_sigma=0.0)
    jumps = [(i, (i + d) % 24) for d in (5, 7, 11) for i in range(24)]
    cov = np.eye(6) * 1e-4
    links = [Link(i, j, geometry.inverse(poses[i]) @ poses[j], cov, 1.0, 9) for i, j in map(sorted, jumps)]
    turned = geometry.exp(np.array([0, 0, 0.3, 0, 0, 0]))
    links += [link._replace(i_from_j=link.i_from_j @ turned, cov=np.eye(6)) for link in exact if link.j == link.i + 1]
    start, zero = pose_graph.chordal_start(links), geometry.inverse(poses[0])
    off = [np.linalg.norm(start.atPose3(k).matrix() - zero @ pose) for k, pose in enumerate(poses)]
    assert max(off) < 0.05


def test_the_lowest_number_stays_where_it_starts():
    poses, links = ring(np.random.default_rng(2))
    moved = geometry.exp(np.array([0.3, -0.2, 1.0, 4.0, 5.0, 6.0]))
    solved = pose_graph.solve(links, {k: moved @ pose for k, pose in enumerate(poses)})
    np.testing.assert_allclose(solved.poses[0], moved @ poses[0], atol=1e-9)
    still = pose_graph.solve(links, dict(enumerate(poses)))
    assert solved.cost == pytest.approx(still.cost, abs=1e-3)
    np.testing.assert_allclose(solved.poses[7], moved @ still.poses[7], atol=2e-4)  # 0.01 of its standard deviation


def test_a_robust_kernel_bends_less_to_a_wrong_link():
    poses, links = ring(np.random.default_rng(3))
    links[-1] = links[-1]._replace(i_from_j=links[-1].i_from_j @ geometry.exp(np.array([0, 0, 0, 1.0, 0, 0])))
    plain, robust = (pose_graph.solve(links, huber=huber).poses for huber in (None, 1.0))
    zero = geometry.inverse(poses[0])
    off = [max(np.linalg.norm((zero @ poses[k] - found[k])[:3, 3]) for k in found) for found in (plain, robust)]
    assert off[1] < 0.5 * off[0]


@pytest.mark.parametrize("huber", [None, 2.5])
def test_chi2_is_the_squared_residual_in_units_of_the_covariance(huber):
    poses, links = ring(np.random.default_rng(4))
    start = gtsam.Values()
    for k, pose in enumerate(poses):
        start.insert(k, gtsam.Pose3(pose))
    expected = []
    for link in links:
        error = geometry.log(geometry.inverse(link.i_from_j) @ geometry.inverse(poses[link.i]) @ poses[link.j])
        expected.append(error @ np.linalg.inv(link.cov) @ error)
    assert min(expected) < 2.5**2 < max(expected)
    found = pose_graph.chi2(pose_graph.between_factors(links, huber), start, huber)
    np.testing.assert_allclose(found, expected, rtol=1e-9)


@pytest.mark.parametrize("last", [[11, 3], None])
def test_marginals_are_gtsams(last):
    _, links = ring(np.random.default_rng(5))
    graph, start = gtsam.NonlinearFactorGraph(), pose_graph.chordal_start(links)
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    for factor in pose_graph.between_factors(links):
        graph.add(factor)
    found = pose_graph.optimise(graph, start, last=last)
    oracle = gtsam.Marginals(graph, found.values)
    numbers = range(12) if last is None else last
    for number, cov in zip(numbers, found.marginals(numbers), strict=True):
        expected = oracle.marginalCovariance(number)
        np.testing.assert_allclose(cov, expected, atol=1e-3 * np.diag(expected).max())


def test_what_is_linear_is_eliminated_once(monkeypatch):
    graph, start, eliminate, times = gtsam.NonlinearFactorGraph(), gtsam.Values(), pose_graph._eliminated, []
    for measured in ([1.0, 2.0], [3.0, 8.0]):
        graph.add(gtsam.PriorFactorVector(0, np.array(measured), gtsam.noiseModel.Unit.Create(2)))
    start.insert(0, np.array([100.0, -100.0]))
    monkeypatch.setattr(pose_graph, "_eliminated", lambda *a, **k: times.append(1) or eliminate(*a, **k))
    found = pose_graph.optimise(graph, start)
    np.testing.assert_allclose(found.values.atVector(0), [2.0, 5.0], atol=1e-9)
    assert found.reached and len(times) == 1


def test_a_start_that_leads_gauss_newton_up_ends_at_the_minimum_all_the_same():
    """Of arctan(x)^2 each step of Gauss-Newton from beyond 1.39 leads farther off, to the other side."""

    def arctan(_, values, jacobians):
        x = values.atVector(0)
        if jacobians is not None:
            jacobians[0] = np.array([[1 / (1 + x[0] ** 2)]], order="F")
        return np.arctan(x)

    graph, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    graph.add(gtsam.CustomFactor(gtsam.noiseModel.Unit.Create(1), [0], arctan))
    start.insert(0, np.array([3.0]))
    found = pose_graph.optimise(graph, start)
    assert found.reached
    assert found.values.atVector(0)[0] == pytest.approx(0.0, abs=1e-3)
