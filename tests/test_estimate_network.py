"""Tests of the keyframe network."""

import time
from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from twin.core import geometry
from twin.core.quality import DisparityOffset
from twin.core.records import Readings, SensorNoise, StereoRig
from twin.core.settings import EstimatorSettings
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted
from twin.estimate.network import KeyframeNetwork
from twin.estimate.vision.stereo import Keyframe, StereoPoints
from twin.estimate.vision.two_view_motion import Motion


@pytest.fixture
def network():
    """Returns a network of two nodes on track 1, with a window of the current track alone."""
    vision = Mock(runs_in_background=False)
    settings = EstimatorSettings(window_tracks=0, node_stride=20)
    made = KeyframeNetwork(vision, StereoRig(160, 120, 140.0, 0.1), SensorNoise(), settings, Stopwatch())
    for number in (0, 20):
        start = geometry.pose(np.eye(3), np.array([0.1 * number, 0, 1]))
        made.nodes.append(Keyframe(number, number, 1, start, None, Readings()))
    return made


def test_a_track_without_nodes_is_not_aligned(network):
    assert network.align_window(2) is None
    assert not network.history.alignments and not network.history.before_ga


def keyframe(number):
    """Returns a keyframe over a flat floor, at the same pose as all others."""
    x, y = (axis.ravel() for axis in np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.3, 0.3, 5)))
    xyz, zeros = np.column_stack([x, y, np.ones(25)]), np.zeros((25, 3))
    points = StereoPoints(zeros[:, :2], zeros[:, :2], zeros[:, 0], xyz, np.zeros((25, 3, 3)), xyz, zeros[:, 0])
    return Keyframe(number, number, 1, np.eye(4), points, Readings())


class Numbered:
    """Measures links whose residual and disparity offset name them: 100 times the later node plus the earlier one."""

    def __init__(self, runs_in_background, slow_node=-1, failing_node=-1):
        self.runs_in_background, self.slow_node, self.failing_node = runs_in_background, slow_node, failing_node

    def measure_motions(self, node, others):
        if node.number == self.failing_node and len(others) != 1:
            raise np.linalg.LinAlgError("singular")
        if node.number == self.slow_node and len(others) != 1:
            time.sleep(0.2)  # the links to the last node of later nodes are measured meanwhile
        names = [100 * node.number + other.number for other in others]
        return [Motion(np.eye(4), np.eye(6), 99, n, disparity_offset=DisparityOffset(n, 1.0)) for n in names]


def connected(vision, n):
    """Returns a network of n nodes whose links have not all been collected."""
    made = KeyframeNetwork(vision, StereoRig(160, 120, 140.0, 0.1), SensorNoise(), EstimatorSettings(), Stopwatch())
    for node in map(keyframe, range(n)):
        made.add(node)
        made.connect(node, made.link_to_last_node(node), None, None)
    return made


@pytest.mark.parametrize("background", [True, False])
def test_measurements_are_recorded_in_the_order_of_the_nodes_whichever_thread_ends_first(background):
    """Regression: sums over the disparity offsets depended on the order in which two threads appended them."""
    network = connected(Numbered(background, slow_node=3), 6)
    network.truncate(6)
    names = network.history.disparity_offsets.array[:, 0].tolist()
    assert names == network.history.link_residuals == [100 * link.j + link.i for link in network.links]
    assert len(names) > 10 and [name // 100 for name in names] == sorted(name // 100 for name in names)


def test_the_yaw_by_many_links_takes_little_longer_than_by_few():
    """Regression: from lists of all links, made at every keyframe, it took most of the time of a long survey."""
    network, times_s = connected(Numbered(False), 3), []
    network.rig = replace(network.rig, yaw_sigma_rad=1e-3)
    for n in (100, 20000):
        network.history.yaws.append(np.tile([1e-3, 1e-4], (n, 1)))
        runs_s = []
        for _ in range(20):
            start_s = time.process_time()
            network.yaw_rad()
            runs_s.append(time.process_time() - start_s)
        times_s.append(min(runs_s))
    assert times_s[1] < 20 * times_s[0]


@pytest.mark.parametrize("background", [True, False])
def test_after_any_error_of_a_measurement_nothing_is_pending_and_the_network_is_not_aligned(background):
    network = connected(Numbered(background, failing_node=4), 6)
    with pytest.raises(np.linalg.LinAlgError):
        network.truncate(100)
    network.truncate(100)
    assert network.align_all() is None


def test_an_alignment_that_fails_leaves_no_positions_before_it(network, monkeypatch):
    def fails(*_, **__):
        raise SurveyAborted("the global alignment failed")

    monkeypatch.setattr(network, "_align", fails)
    with pytest.raises(SurveyAborted):
        network.align_window(1)
    assert len(network.history.before_ga) == len(network.history.after_ga) == 0
