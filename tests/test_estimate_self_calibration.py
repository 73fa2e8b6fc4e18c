"""Self-calibration: the yaw between the cameras and the baseline, estimated with the motions and with the poses."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from twin.core import geometry
from twin.core.quality import DisparityOffset
from twin.core.records import Readings, SensorNoise, StereoRig
from twin.estimate import link_selection
from twin.estimate.alignment import align
from twin.estimate.self_calibration import MeasuredErrors
from twin.estimate.vision import two_view_motion
from twin.estimate.vision.image_errors import N_COEFFICIENTS, coefficient_sigmas, image_errors
from twin.estimate.vision.observation_equations import PairMeasurements
from twin.estimate.vision.stereo import Keyframe

BASELINE_M = 0.15
SIGMA = np.array([2e-4, 2e-4, 3e-4])
RIG = StereoRig(320, 240, 277.0, BASELINE_M)
STEP = geometry.exp(np.array([0.01, -0.02, 0.05, 0.25, -0.1, 0.03]))


def reef(rng, n=300, relief_m=0.4):
    depth = 2.0 + rng.uniform(-relief_m, relief_m, n)
    return np.column_stack([rng.uniform(-0.5, 0.5, (n, 2)) * depth[:, None], depth])


def observed(points, yaw, baseline_m=BASELINE_M):
    """Returns (x, y, disparity) (n, 3) of points in the left camera; the right one is turned away by the yaw [rad].

    As `stereo.fuse` does with equal noise in both images, y is the mean of both rows.
    """
    turned = (points - [baseline_m, 0, 0]) @ geometry.exp(np.array([0, yaw, 0, 0, 0, 0]))[:3, :3]
    left, right = (p[:, :2] / p[:, 2:] for p in (points, turned))
    return np.column_stack([left[:, 0], (left[:, 1] + right[:, 1]) / 2, left[:, 0] - right[:, 0]])


def corrected(z, yaw):
    """Returns observations (n, 3) from images that were corrected for a yaw [rad], to first order."""
    x = z[:, 0] - z[:, 2]
    return z - yaw * np.column_stack([np.zeros(len(z)), -x * z[:, 1] / 2, 1 + x**2])


def motion(points, a_from_b, yaw, rng=None, removed=0.0, baseline_m=BASELINE_M):
    pairs = points, geometry.transform(geometry.inverse(a_from_b), points)
    noise = [0.0 if rng is None else SIGMA * rng.normal(size=points.shape) for _ in pairs]
    a, b = (corrected(observed(p, yaw, baseline_m) + e, removed) for p, e in zip(pairs, noise, strict=True))
    cov = np.tile(np.diag(SIGMA**2), (len(a), 1, 1))
    found = two_view_motion.pair_motion(PairMeasurements(a, b, cov, cov), BASELINE_M, a_from_b)
    assert found is not None and found.yaw is not None
    return found._replace(yaw=found.yaw._replace(estimate=found.yaw.estimate + removed, removed_rad=removed))


@pytest.mark.parametrize(("relief_m", "removed"), [(0.4, 0.0), (0.0, 0.0), (0.4, 1.5e-3)])
def test_the_error_of_the_yaw_of_a_motion_agrees_with_its_standard_deviation(relief_m, removed):
    """Also over a level floor, and from images that were corrected for part of the yaw.

    The mean of 60 squared ratios has a standard error of 0.18.
    """
    rng, yaw = np.random.default_rng(8), 2e-3
    found = [motion(reef(rng, relief_m=relief_m), STEP, yaw, rng, removed).yaw for _ in range(60)]
    assert np.mean([one.estimate for one in found]) == pytest.approx(yaw, rel=0.1)
    assert np.mean([((one.estimate - yaw) / one.sigma) ** 2 for one in found]) == pytest.approx(1.0, abs=0.6)


@pytest.mark.parametrize("removed", [0.0, 8e-4])
def test_the_change_of_a_motion_by_a_yaw_is_that_between_two_measurements(removed):
    yaw, points = 1e-3, reef(np.random.default_rng(1))
    turned = motion(points, STEP, yaw, removed=removed)
    expected = geometry.log(geometry.inverse(turned.a_from_b) @ STEP)
    np.testing.assert_allclose(
        turned.yaw.by_yaw * (yaw - removed), expected, atol=0.03 * np.abs(turned.yaw.by_yaw * yaw).max()
    )


def survey(rng, yaw, baseline_m=BASELINE_M, removed=lambda k: 0.0, n=12):
    """Returns the true poses, the nodes at them, their links to the last two nodes, and the mean yaw of the links."""
    poses = [np.eye(4)]
    for _ in range(n - 1):
        poses.append(poses[-1] @ STEP)
    links, yaws = [], []
    for j in range(1, n):
        for i in range(max(j - 2, 0), j):
            i_from_j = geometry.inverse(poses[i]) @ poses[j]
            found = motion(reef(rng), i_from_j, yaw, rng, removed(j), baseline_m)
            nodes = (Keyframe(k, k, 1, poses[k], None, Readings()) for k in (j, i))
            links.append(link_selection.to_link(*nodes, 0.7, found))
            yaws.append(found.yaw)
    nodes = [Keyframe(k, k, 1, pose, None, Readings()) for k, pose in enumerate(poses)]
    weight = np.array([one.sigma for one in yaws]) ** -2
    mean = float(np.sum(weight * [one.estimate for one in yaws]) / weight.sum())
    return np.array(poses), nodes, links, DisparityOffset(mean, weight.sum() ** -0.5)


def aligned(nodes, links, rig, yaw=None):
    return align(nodes, links, {0: np.eye(6) * 1e-12}, rig, SensorNoise(), None, MeasuredErrors(yaw))


def position_errors(result, poses):
    return np.linalg.norm(result.poses[:, :3, 3] - poses[:, :3, 3], axis=1)


def test_the_alignment_removes_the_effect_of_a_yaw_and_its_covariances_say_what_remains():
    """0.06 degrees, unknown: 20 mm; with self-calibration a tenth, as the covariances say, in each of five surveys."""
    yaw, rig = np.deg2rad(0.06), replace(RIG, yaw_sigma_rad=np.deg2rad(0.06))
    for seed in range(5):
        poses, nodes, links, measured = survey(np.random.default_rng(seed), yaw)
        exact, found = aligned(nodes, links, RIG), aligned(nodes, links, rig, measured)
        assert position_errors(found, poses).max() < 0.2 * position_errors(exact, poses).max()
        assert abs(found.calibration.yaw_rad - yaw) < 4 * found.calibration.cov[0, 0] ** 0.5
        errors = [geometry.log(geometry.inverse(pose) @ true) for pose, true in zip(found.poses, poses, strict=True)]
        nees = [e[3:] @ np.linalg.solve(c[3:, 3:], e[3:]) for e, c in zip(errors[1:], found.covs[1:], strict=True)]
        assert np.mean(nees) < 12  # 3 expected; the errors along a path are correlated


def test_links_of_corrected_images_give_the_poses_of_those_of_uncorrected_images():
    yaw, rig = np.deg2rad(0.06), replace(RIG, yaw_sigma_rad=np.deg2rad(0.06))
    results = []
    for removed in (lambda k: 0.0, lambda k: yaw * (k > 3)):
        poses, nodes, links, measured = survey(np.random.default_rng(3), yaw, removed=removed)
        results.append(aligned(nodes, links, rig, measured))
    difference = np.linalg.norm(results[0].poses[:, :3, 3] - results[1].poses[:, :3, 3], axis=1)
    assert (
        difference.max()
        < 0.05 * position_errors(aligned(*survey(np.random.default_rng(3), yaw)[1:3], RIG), poses).max()
    )


def test_an_unobservable_baseline_is_as_uncertain_as_the_calibration_states():
    """Without a navigation sensor: the distance of the last node from the first has its relative sigma at least."""
    rig = replace(RIG, baseline_sigma=0.01)
    poses, nodes, links, _ = survey(np.random.default_rng(5), 0.0, BASELINE_M * 1.01)
    found = aligned(nodes, links, rig)
    assert found.calibration.baseline_error == pytest.approx(0.0, abs=1e-3)
    assert found.calibration.cov[1, 1] ** 0.5 == pytest.approx(0.01, rel=0.05)
    along = poses[-1, :3, 3] / np.linalg.norm(poses[-1, :3, 3])
    in_camera = found.poses[-1, :3, :3].T @ along
    sigma_m = (in_camera @ found.covs[-1, 3:, 3:] @ in_camera) ** 0.5
    distance_m = np.linalg.norm(poses[-1, :3, 3])
    assert 0.0098 * distance_m < sigma_m < 0.013 * distance_m
    assert position_errors(found, poses)[-1] == pytest.approx(0.01 * distance_m, rel=0.3)


def test_positions_of_an_acoustic_system_reveal_an_error_of_the_baseline():
    rig, noise = replace(RIG, baseline_sigma=0.02), SensorNoise(usbl_m=1e-3)
    poses, nodes, links, _ = survey(np.random.default_rng(6), 0.0, BASELINE_M * 1.02)
    body = [pose[:3, 3] for pose in poses]
    for node, position in zip(nodes, body, strict=True):
        node.readings = Readings(usbl_m=position)
    found = align(nodes, links, {0: np.eye(6) * 1e-12}, rig, noise)
    sigma = found.calibration.cov[1, 1] ** 0.5
    assert sigma < 0.002
    assert found.calibration.baseline_error == pytest.approx(0.02, abs=4 * sigma)


HALF_SIZE = np.array([160, 120]) / 277.0


def wrong(z, coefficients):
    return z + image_errors(z, HALF_SIZE) @ coefficients


def wrong_motion(rng, a_from_b, coefficients):
    points = reef(rng)
    pairs = (observed(p, 0.0) for p in (points, geometry.transform(geometry.inverse(a_from_b), points)))
    a, b = (wrong(z, coefficients) + SIGMA * rng.normal(size=z.shape) for z in pairs)
    cov = np.tile(np.diag(SIGMA**2), (len(a), 1, 1))
    settings = two_view_motion.PairMotionSettings(half_size=HALF_SIZE)
    return two_view_motion.pair_motion(PairMeasurements(a, b, cov, cov), BASELINE_M, a_from_b, settings)


def test_image_errors_of_a_row_pattern_have_its_size_in_rows_and_columns_over_the_image():
    """Row differences are not in stereo points, whose rows are means of two images: half the variance of one."""
    u, v = np.meshgrid(*(np.linspace(-half, half, 201) for half in HALF_SIZE))
    points = np.column_stack([u.ravel(), v.ravel(), np.full(u.size, 0.05)])
    errors = image_errors(points, HALF_SIZE) * coefficient_sigmas(1e-3)
    rms = np.sqrt(np.mean(np.sum(errors**2, axis=2), axis=0))
    np.testing.assert_allclose(rms, [1e-3 / 2**0.5, 1e-3 / 2, 1e-3], rtol=0.02)


def test_the_correction_by_an_image_error_is_that_between_two_measurements():
    for k in range(N_COEFFICIENTS):
        coefficients = 2e-5 * (np.arange(N_COEFFICIENTS) == k)
        right, found = (wrong_motion(np.random.default_rng(2), STEP, c) for c in (0 * coefficients, coefficients))
        expected = geometry.log(geometry.inverse(found.a_from_b) @ right.a_from_b)
        size = np.abs(right.by_image_errors[:, k] * 2e-5).max()
        np.testing.assert_allclose(right.by_image_errors @ coefficients, expected, atol=0.2 * size, err_msg=str(k))


def test_positions_with_image_errors_are_as_uncertain_as_the_alignment_says():
    """Errors drawn for a row pattern of 0.2 px, in 8 surveys: NEES of the last node 3 expected, above 100 without."""
    pattern, nees = 0.2 / 277.0, np.zeros((8, 2))
    for seed in range(len(nees)):
        rng = np.random.default_rng(seed)
        coefficients = coefficient_sigmas(pattern) * rng.normal(size=N_COEFFICIENTS)
        poses = np.array([geometry.exp(k * geometry.log(STEP)) for k in range(8)])
        nodes = [Keyframe(k, k, 1, pose, None, Readings()) for k, pose in enumerate(poses)]
        links = []
        for j in range(1, 8):
            for i in range(max(j - 2, 0), j):
                found = wrong_motion(rng, geometry.inverse(poses[i]) @ poses[j], coefficients)
                links.append(link_selection.to_link(nodes[j], nodes[i], 0.7, found))
        for column, believed in enumerate((pattern, 0.0)):
            found = align(
                nodes, links, {0: np.eye(6) * 1e-12}, RIG, SensorNoise(), None, MeasuredErrors(None, believed)
            )
            error = geometry.log(geometry.inverse(found.poses[-1]) @ poses[-1])[3:]
            nees[seed, column] = error @ np.linalg.solve(found.covs[-1, 3:, 3:], error)
    assert 1.3 < nees[:, 0].mean() < 5.5 and nees[:, 1].mean() > 100


def distorted(z, k1):
    """Returns stereo points (n, 3) of two cameras whose images have the radial distortion k1."""
    left, right = (np.column_stack([column, z[:, 1]]) for column in (z[:, 0], z[:, 0] - z[:, 2]))
    left, right = (p * (1 + k1 * np.sum(p**2, axis=1))[:, None] for p in (left, right))
    return np.column_stack([left[:, 0], (left[:, 1] + right[:, 1]) / 2, left[:, 0] - right[:, 0]])


@pytest.mark.parametrize("yaw", [0.0, 3e-3])
def test_the_error_of_a_radial_distortion_agrees_with_its_standard_deviation(yaw):
    """Also with a yaw, from which it differs little; 0.83 px of yaw enlarge the residuals and the standard deviation.

    The mean of 60 squared ratios has a standard error of 0.18.
    """
    rng, k1, found = np.random.default_rng(11), 0.02, []
    for _ in range(60):
        points = reef(rng)
        pairs = (observed(p, yaw) for p in (points, geometry.transform(geometry.inverse(STEP), points)))
        a, b = (distorted(z, k1) + SIGMA * rng.normal(size=z.shape) for z in pairs)
        cov = np.tile(np.diag(SIGMA**2), (len(a), 1, 1))
        found.append(two_view_motion.pair_motion(PairMeasurements(a, b, cov, cov), BASELINE_M, STEP).distortion)
    assert np.mean([one.estimate for one in found]) == pytest.approx(k1, rel=0.1)
    ratio = np.mean([((one.estimate - k1) / one.sigma) ** 2 for one in found])
    assert (0.2 if yaw else 0.4) < ratio < 1.6


@pytest.mark.long
def test_a_rendered_survey_finds_the_yaw_that_its_seed_drew(tmp_path):
    """Seed 1 draws 0.14 deg with a sigma of 0.06: uncorrected, 0.65 px of 20 px, or 6 cm of height at 2 m."""
    from twin import survey
    from twin.scenario.file import load_scenario

    keys = ["calibration_error.rotation_sigma_deg=0.06", "plan.area_m=[1.5,1.0]", "plan.tracks=1", "seed=1"]
    scenario = load_scenario("reef", keys)
    run = survey.run(scenario, tmp_path / "run", outputs=())
    found = run.metrics["self_check"]["calibration"]
    yaw_deg = scenario.true_calibration_error().right_yaw_deg
    assert abs(found["yaw_deg"] - yaw_deg) < min(4 * found["yaw_sigma_deg"], 0.01)
    assert run.metrics["status"] == "complete"
    assert run.metrics["trajectory"]["final"]["ate_max_m"] < 4e-3
    assert run.metrics["map"]["le90_m"] < 8e-3 and 0.5 < run.metrics["map"]["sigma_ratio"] < 2
