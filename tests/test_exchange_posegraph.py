"""Pose graph files: GTSAM reads the written network."""

from types import SimpleNamespace

import gtsam
import numpy as np

from twin.core import geometry
from twin.core.links import Link, Links
from twin.core.records import Trajectory
from twin.exchange import posegraph


def test_gtsam_reads_poses_motions_and_covariances_of_a_written_network(tmp_path):
    rng = np.random.default_rng(0)
    poses = np.array([geometry.exp(rng.normal(size=6)) for _ in range(3)])
    root = rng.normal(size=(6, 6)) * 0.01
    link = Link(0, 2, geometry.exp(rng.normal(size=6)), root @ root.T, 0.5, 9)
    result = SimpleNamespace(final=Trajectory(np.arange(3.0), poses), keyframe_rows=np.arange(3), links=Links([link]))
    posegraph.write(tmp_path / "graph.g2o", result)
    graph, values = gtsam.readG2o(str(tmp_path / "graph.g2o"), True)
    np.testing.assert_allclose([values.atPose3(k).matrix() for k in range(3)], poses, atol=1e-10)
    edge = graph.at(0)
    assert graph.size() == 1 and list(edge.keys()) == [0, 2]
    np.testing.assert_allclose(edge.measured().matrix(), link.i_from_j, atol=1e-10)
    np.testing.assert_allclose(edge.noiseModel().covariance(), link.cov, rtol=1e-5, atol=1e-9)
