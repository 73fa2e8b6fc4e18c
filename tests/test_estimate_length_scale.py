"""Sensors that know lengths reveal a wrong baseline, and a wrong focal length where the camera moves along its axis."""

from dataclasses import replace

import numpy as np
import pytest

from twin.core import geometry
from twin.core.links import Link, Links
from twin.core.quality import EstimationQuality, LengthScale
from twin.core.records import Displacement, Readings, SensorNoise, StereoRig
from twin.estimate.calibration_errors import length_scales
from twin.estimate.self_check import MAX_SCALE_ERROR, _scale
from twin.estimate.vision.stereo import Keyframe

BODY_FROM_CAMERA = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.2, 0.06, -0.1]))
RIG = StereoRig(320, 240, 300.0, 0.12, 15.0, BODY_FROM_CAMERA)
NOISE = SensorNoise()
STEP_COV = np.diag([2e-4] * 3 + [8e-4, 8e-4, 4e-4]) ** 2


def survey(seed, across=1.0, along=1.0, relief_m=0.4, n=120, sensors=("dvl", "usbl", "pressure"), dvl=1.0):
    """Returns nodes and links of two legs of 18 m; motions across and along the axis have the given scales."""
    rng = np.random.default_rng(seed)
    dvl *= 1 + rng.normal(0, NOISE.dvl_scale)
    s = np.minimum(np.arange(n), n - np.arange(n)) * 0.3
    positions = np.column_stack([s, 0.02 * np.arange(n), 2 + relief_m * np.sin(s)])
    tilts = rng.normal(0, 0.02, (n, 3))
    true = [
        geometry.pose(geometry.rotation_from_rpy(*tilt) @ geometry.BODY_FROM_DOWN_CAMERA, p)
        for tilt, p in zip(tilts, positions, strict=True)
    ]
    nodes, links = [], []
    for k, pose in enumerate(true):
        height = positions[k, 2] + rng.normal(0, NOISE.pressure_m) if "pressure" in sensors else None
        fix = positions[k] + rng.normal(0, NOISE.usbl_m, 3) if "usbl" in sensors else None
        node = Keyframe(k, k, 1, pose, None, Readings(pressure_z_m=height, usbl_m=fix))
        nodes.append(node)
        if not k:
            continue
        motion = geometry.inverse(true[k - 1]) @ pose
        scaled = motion.copy()
        scaled[:3, 3] *= [across, across, along]
        error = geometry.exp(rng.multivariate_normal(np.zeros(6), STEP_COV))
        links.append(Link(k - 1, k, scaled @ error, STEP_COV, 0.8, 100))
        if "dvl" in sensors:
            body = BODY_FROM_CAMERA @ motion @ geometry.inverse(BODY_FROM_CAMERA)
            cov = np.eye(3) * 8e-4**2
            node.dvl_displacement = Displacement(k - 1, dvl * body[:3, 3] + rng.normal(0, 8e-4, 3), cov)
    return nodes, Links(links)


def scales(*args, **changes):
    return length_scales(*survey(*args, **changes), RIG, NOISE)


def test_a_right_rig_is_within_its_standard_deviations():
    """60 seeds: the mean of z^2 has the standard deviation 0.18; the estimate of sigma is conservative along the axis.

    No seed gives a finding, although each has a random scale error of its DVL.
    """
    found = [scales(seed) for seed in range(60)]
    z = np.array([[(scale.estimate - 1) / scale.sigma for scale in pair] for pair in found])
    assert 0.6 < (z[:, 0] ** 2).mean() < 1.6 and (z[:, 1] ** 2).mean() < 1.6 and np.abs(z).max() < 4
    assert not [f for a, b in found for f in _scale(EstimationQuality(length_scale=a, depth_scale=b))]


@pytest.mark.parametrize("error", [-0.2, -0.015, 0.015, 0.2])
def test_a_wrong_baseline_is_found_from_one_percent_on(error):
    across, along = scales(3, across=1 + error, along=1 + error)
    assert abs(across.estimate - 1 - error) < 3 * across.sigma and across.sigma < 0.0025
    assert abs(along.estimate - 1 - error) < 4 * along.sigma
    assert _scale(EstimationQuality(length_scale=across))[0].check == "length_scale"


def test_a_wrong_focal_length_is_found_where_the_height_changes():
    across, along = scales(4, along=1.1)
    assert abs(across.estimate - 1) < 3 * across.sigma and abs(along.estimate - 1.1) < 4 * along.sigma
    (finding,) = _scale(EstimationQuality(length_scale=across, depth_scale=along))
    assert finding.check == "depth_scale" and "focal length" in finding.sentence


def test_at_constant_height_an_error_of_the_focal_length_is_not_claimed():
    """Only the tilts of the vehicle, 1 degree, turn a part of the motion along the axis."""
    for seed in range(20):
        across, along = scales(seed, relief_m=0.0, along=1.1)
        assert across.sigma < 0.003 and (along is None or along.sigma > 0.05)
        assert not list(_scale(EstimationQuality(length_scale=across, depth_scale=along)))


def test_without_a_sensor_that_knows_lengths_nothing_is_claimed():
    assert scales(1, across=1.2, sensors=()) == (None, None)
    assert length_scales([], Links(), RIG, NOISE) == (None, None)


def test_each_sensor_is_named_for_the_scale_that_it_determines():
    across, along = scales(2)
    assert across.sensors == "DVL" and "pressure" in along.sensors
    assert scales(2, sensors=("usbl",))[0].sensors == "USBL"
    assert scales(2, sensors=("pressure",))[0] is None


def test_usbl_alone_finds_a_baseline_error_of_a_fifth():
    across, _ = scales(5, across=1.2, along=1.2, sensors=("usbl",))
    assert abs(across.estimate - 1.2) < 4 * across.sigma and list(_scale(EstimationQuality(length_scale=across)))


def test_small_or_uncertain_differences_are_no_finding():
    for estimate, sigma in [(1 + 0.9 * MAX_SCALE_ERROR, 1e-4), (1.1, 0.035)]:
        assert not list(_scale(EstimationQuality(length_scale=LengthScale(estimate, sigma, "DVL"))))


def test_a_difference_of_more_than_three_sigma_is_a_finding():
    """An error of the focal length of 3 % over a cross line 0.6 m higher: sigma 0.7 %, found in 9 of 10 surveys."""
    assert list(_scale(EstimationQuality(depth_scale=LengthScale(0.975, 0.007, "pressure"))))


def test_motion_bridged_by_other_sensors_is_not_evidence():
    nodes, links = survey(6, sensors=("dvl",))
    bridged = Links([link._replace(n_points=0) for link in links])
    assert length_scales(nodes, bridged, RIG, NOISE) == (None, None)
    assert length_scales(nodes, links, replace(RIG, baseline_m=0.2), NOISE) == length_scales(nodes, links, RIG, NOISE)
