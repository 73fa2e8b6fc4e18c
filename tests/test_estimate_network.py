"""Tests of the keyframe network."""

from unittest.mock import Mock

import numpy as np
import pytest

from twin.core import geometry
from twin.core.records import Readings, SensorNoise, StereoRig
from twin.core.settings import EstimatorSettings
from twin.core.timing import Stopwatch
from twin.errors import SurveyAborted
from twin.estimate.network import KeyframeNetwork
from twin.estimate.vision.keyframes import Keyframe


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


def test_after_any_error_of_a_measurement_nothing_is_pending_and_the_network_is_not_aligned(network):
    def fails():
        raise np.linalg.LinAlgError("singular")

    for measure in (fails, list):
        network._queue.submit(measure)
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
