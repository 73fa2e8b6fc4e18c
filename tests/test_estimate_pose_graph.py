"""The alignment's core on public pose graphs against gtsam's optimum, and its parts against closed forms."""

import os
from pathlib import Path

import gtsam
import numpy as np
import pytest
from evo.core.metrics import APE, PoseRelation
from evo.core.trajectory import PosePath3D

from twin.core import geometry
from twin.core.links import Link
from twin.estimate.adjustment import block_cholesky, chordal, pose_graph
from twin.exchange import posegraph

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
    assert chordal.solve(links).cost == pytest.approx(517.93, rel=1e-4)


def test_the_sphere_reaches_gtsams_optimum_and_the_truth():
    links = public("sphere2500.txt")
    solved = chordal.solve(links)
    assert solved.cost == pytest.approx(gtsam_on_its_own(links), rel=1e-5)
    assert truth_error_m(solved.poses) <= 0.21


def test_the_sphere_read_per_quaternion_component_costs_what_is_asked():
    solved = chordal.solve([per_quaternion(link) for link in public("sphere2500.txt")])
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
    start = chordal.chordal_start(exact)
    zero = geometry.inverse(poses[0])
    for k, pose in enumerate(poses):
        np.testing.assert_allclose(start[k], zero @ pose, atol=1e-9)
    poses, links = ring(np.random.default_rng(1))
    by_chords, by_truth = (chordal.solve(links, start) for start in (None, dict(enumerate(poses))))
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
    start, zero = chordal.chordal_start(links), geometry.inverse(poses[0])
    off = [np.linalg.norm(start[k] - zero @ pose) for k, pose in enumerate(poses)]
    assert max(off) < 0.05


def test_the_chordal_start_is_a_rotation_where_links_average_to_a_reflection():
    """Half turns about three axes have the mean -I / 3."""
    turns = [geometry.exp(np.append(np.pi * axis, np.zeros(3))) for axis in np.eye(3)]
    found = chordal.chordal_start([Link(0, 1, turn, np.eye(6), 1.0, 9) for turn in turns])[1][:3, :3]
    np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-9)
    assert np.linalg.det(found) == pytest.approx(1.0)


def test_the_lowest_number_stays_where_it_starts():
    poses, links = ring(np.random.default_rng(2))
    moved = geometry.exp(np.array([0.3, -0.2, 1.0, 4.0, 5.0, 6.0]))
    solved = chordal.solve(links, {k: moved @ pose for k, pose in enumerate(poses)})
    np.testing.assert_allclose(solved.poses[0], moved @ poses[0], atol=1e-9)
    still = chordal.solve(links, dict(enumerate(poses)))
    assert solved.cost == pytest.approx(still.cost, abs=1e-3)
    np.testing.assert_allclose(solved.poses[7], moved @ still.poses[7], atol=2e-4)  # 0.01 of its standard deviation


def test_a_robust_kernel_bends_less_to_a_wrong_link():
    poses, links = ring(np.random.default_rng(3))
    links[-1] = links[-1]._replace(i_from_j=links[-1].i_from_j @ geometry.exp(np.array([0, 0, 0, 1.0, 0, 0])))
    plain, robust = (chordal.solve(links, huber=huber).poses for huber in (None, 1.0))
    zero = geometry.inverse(poses[0])
    off = [max(np.linalg.norm((zero @ poses[k] - found[k])[:3, 3]) for k in found) for found in (plain, robust)]
    assert off[1] < 0.5 * off[0]


def graph_of(poses, links, huber=None):
    """The graph of links between poses 0 to n - 1, the first one held."""
    held = pose_graph.given([0], np.array(poses[:1]), np.eye(6)[None] * 1e-6)
    return pose_graph.Graph(len(poses), [held], [pose_graph.motions(links, {k: k for k in range(len(poses))}, huber)])


@pytest.mark.parametrize("huber", [None, 2.5])
def test_chi2_is_the_squared_residual_in_units_of_the_covariance(huber):
    """And F their half, but for those beyond Huber's limit, which count linearly."""
    poses, links = ring(np.random.default_rng(4), share_of_sigma=2.5)
    found = pose_graph.optimise(graph_of(poses, links, huber), pose_graph.State(np.array(poses)))
    expected, losses = [], []
    for link in links:
        between = geometry.inverse(found.state.poses[link.i]) @ found.state.poses[link.j]
        error = geometry.log(geometry.inverse(link.i_from_j) @ between)
        expected.append(error @ np.linalg.inv(link.cov) @ error)
        size = np.sqrt(expected[-1])
        losses.append(size**2 / 2 if huber is None or size <= huber else huber * (size - huber / 2))
    assert min(expected) < 2.5**2 < max(expected)
    np.testing.assert_allclose(found.chi2[0], expected, rtol=1e-9)
    assert found.cost == pytest.approx(sum(losses), abs=1e-6)


def test_marginals_are_gtsams():
    _, links = ring(np.random.default_rng(5))
    start = chordal.solve(links).poses
    found = pose_graph.optimise(
        graph_of([start[k] for k in range(12)], links), pose_graph.State(np.array(list(start.values())))
    )
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for link in links:
        noise = gtsam.noiseModel.Gaussian.Covariance(link.cov)
        graph.add(gtsam.BetweenFactorPose3(link.i, link.j, gtsam.Pose3(link.i_from_j), noise))
    graph.add(gtsam.PriorFactorPose3(0, gtsam.Pose3(start[0]), gtsam.noiseModel.Isotropic.Sigma(6, 1e-3)))
    for k, pose in enumerate(found.state.poses):
        values.insert(k, gtsam.Pose3(pose))
    oracle, single = gtsam.Marginals(graph, values), [found.marginal(k) for k in range(12)]
    covs = found.into_marginals()
    for k in range(12):
        expected = oracle.marginalCovariance(k)
        np.testing.assert_allclose(covs[k], expected, atol=1e-5 * np.diag(expected).max())
        np.testing.assert_allclose(single[k], covs[k], rtol=1e-9, atol=1e-9 * np.diag(expected).max())


def along_x(measured_m, reading=lambda way_m: way_m):
    """Two poses on the x axis, the first held, and readings of the way between them."""
    held = pose_graph.given([0], np.eye(4)[None], np.eye(6)[None] * 1e-12)
    on_axis = pose_graph.given([1], np.eye(4)[None], np.diag([1e-6] * 3 + [1e6, 1e-6, 1e-6])[None])

    def derive(i_from_j, shared, residuals):
        way_m, step = i_from_j[:, 0, 3], 1e-6
        by_j = np.zeros((len(way_m), 1, 6))
        by_j[:, 0, 3] = (reading(way_m + step) - reading(way_m - step)) / (2 * step)
        return by_j, None

    n = len(measured_m)
    ways = pose_graph.Pairs(
        np.zeros(n, int), np.ones(n, int), np.ones((n, 1, 1)),
        lambda i_from_j, shared: (reading(i_from_j[:, 0, 3]) - measured_m)[:, None], derive,
    )  # fmt: skip
    return pose_graph.Graph(2, [held, on_axis], [ways])


def start_at(x):
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[1, 0, 3] = x
    return pose_graph.State(poses)


def test_what_is_linear_is_eliminated_once(monkeypatch):
    factorise, times = block_cholesky.Matrix.factorise, []
    monkeypatch.setattr(block_cholesky.Matrix, "factorise", lambda *a: times.append(1) or factorise(*a))
    found = pose_graph.optimise(along_x(np.array([1.0, 3.0])), start_at(100.0))
    assert found.state.poses[1, 0, 3] == pytest.approx(2.0, abs=1e-5)
    assert found.reached and len(times) == 1


def test_a_start_that_leads_gauss_newton_up_ends_at_the_minimum_all_the_same(monkeypatch):
    """Of arctan(x)^2 each step of Gauss-Newton from beyond 1.39 leads farther off, to the other side."""
    factorise, rooms = block_cholesky.Matrix.factorise, []
    monkeypatch.setattr(block_cholesky.Matrix, "factorise", lambda *a: rooms.append(id(a[0].panels)) or factorise(*a))
    found = pose_graph.optimise(along_x(np.zeros(1), np.arctan), start_at(3.0))
    assert found.reached
    assert found.state.poses[1, 0, 3] == pytest.approx(0.0, abs=1e-3)
    assert len(rooms) > 3 and len(set(rooms)) == 1  # no two factors at a time


def test_a_search_that_ends_damped_tells_the_covariance_of_the_equations_as_they_are():
    """At 3 m arctan has the slope 1/10; six steps lead up or go nowhere."""
    found = pose_graph.optimise(along_x(np.zeros(1), np.arctan), start_at(3.0), iterations=6)
    assert not found.reached and found.state.poses[1, 0, 3] == 3.0
    assert found.marginal(1)[3, 3] == pytest.approx(1 / (0.1**2 + 1e-6), rel=1e-4)


def test_an_unknown_that_all_pairs_share_is_solved_with_the_poses():
    """Ways of a chain, some also measured with one common scale: the border against the dense equations."""
    n, sigma = 6, 0.3
    rng = np.random.default_rng(8)
    poses = np.tile(np.eye(4), (n, 1, 1))
    poses[:, 0, 3] = np.arange(n)
    cov = np.diag([1e-6] * 3 + [0.01] * 3)
    links = [Link(k, k + 1, poses[1] @ geometry.exp(rng.normal(size=6) * 1e-4), cov, 1.0, 9) for k in range(n - 1)]
    i, measured = np.arange(n - 1), 1.1 + 0.01 * rng.normal(size=n - 1)
    information = np.full((n - 1, 1, 1), 0.02**-2)

    def derive(i_from_j, shared, residuals):
        by_j = np.zeros((n - 1, 1, 6))
        by_j[:, 0, 3:] = (1 + shared) * i_from_j[:, 0, :3]
        return by_j, i_from_j[:, :1, 3]

    scaled = pose_graph.Pairs(
        i, i + 1, information,
        lambda i_from_j, shared: ((1 + shared) * i_from_j[:, 0, 3] - measured)[:, None], derive,
    )  # fmt: skip
    alone = graph_of(poses, links)
    found = pose_graph.optimise(
        alone._replace(pairs=[*alone.pairs, scaled], shared_sigma=sigma), pose_graph.State(poses)
    )

    def cost(unknown):
        moved = np.array(
            [pose @ geometry.exp(step) for pose, step in zip(poses, unknown[:-1].reshape(n, 6), strict=True)]
        )
        total = np.sum(unknown[:6] ** 2) / 1e-6 + (unknown[-1] / sigma) ** 2
        for link in links:
            error = geometry.log(geometry.inverse(link.i_from_j) @ geometry.inverse(moved[link.i]) @ moved[link.j])
            total += error @ np.linalg.inv(cov) @ error
        between = [geometry.inverse(a) @ b for a, b in zip(moved, moved[1:], strict=False)]
        off = (1 + unknown[-1]) * np.array([motion[0, 3] for motion in between]) - measured
        return (total + np.sum(off**2) / 0.02**2) / 2

    steps = [geometry.log(geometry.inverse(a) @ b) for a, b in zip(poses, found.state.poses, strict=True)]
    at = np.append(np.concatenate(steps), found.state.shared)
    assert cost(at) == pytest.approx(found.cost, rel=1e-6)
    assert 0.05 < found.state.shared < 0.15
    for k in range(len(at)):
        nudge = np.zeros(len(at))
        nudge[k] = 1e-3
        assert min(cost(at + nudge), cost(at - nudge)) > found.cost


def test_a_graph_that_holds_not_every_pose_is_told():
    """A pose without a link; a ring that may move as a whole along an axis: only rounding is left to divide by."""
    poses, links = ring(np.random.default_rng(9))
    loose = graph_of([*poses, np.eye(4)], links)
    with pytest.raises(np.linalg.LinAlgError, match="not every pose is held"):
        pose_graph.optimise(loose, pose_graph.State(np.array([*poses, np.eye(4)])))
    for seed in range(10):
        poses, links = ring(np.random.default_rng(seed))
        held = pose_graph.given([0], np.array(poses[:1]), np.diag([1e-6] * 5 + [1e30])[None])
        adrift = graph_of(poses, links)._replace(singles=[held])
        with pytest.raises(np.linalg.LinAlgError):
            pose_graph.optimise(adrift, pose_graph.State(np.array(poses)))
