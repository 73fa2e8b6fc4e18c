"""Pose graph files: both formats give the same motions and covariances, and written files are read back."""

import re
from types import SimpleNamespace

import numpy as np
import pytest

from twin.core import geometry
from twin.core.links import Link, Links
from twin.core.records import Trajectory
from twin.errors import TwinError
from twin.exchange import posegraph

UPPER = np.triu_indices(6)


def text(values):
    return " ".join(f"{v:.12g}" for v in values)


def test_a_written_network_is_read_back(tmp_path):
    rng = np.random.default_rng(0)
    poses = np.array([geometry.exp(rng.normal(size=6)) for _ in range(3)])
    root = rng.normal(size=(6, 6)) * 0.01
    link = Link(0, 2, geometry.exp(rng.normal(size=6)), root @ root.T, 0.5, 9)
    result = SimpleNamespace(final=Trajectory(np.arange(3.0), poses), keyframe_rows=np.arange(3), links=Links([link]))
    posegraph.write(tmp_path / "graph.g2o", result)
    graph = posegraph.read(tmp_path / "graph.g2o")
    np.testing.assert_allclose([graph.poses[k] for k in range(3)], poses, atol=1e-10)
    assert (graph.links[0].i, graph.links[0].j) == (0, 2)
    np.testing.assert_allclose(graph.links[0].i_from_j, link.i_from_j, atol=1e-10)
    np.testing.assert_allclose(graph.links[0].cov, link.cov, rtol=1e-5, atol=1e-9)


def test_toro_information_on_roll_pitch_yaw_is_converted_to_the_rotation_vector(tmp_path):
    """Compares with the Jacobian of the rotation vector by finite differences of the angles."""
    values, sigmas = np.array([1.0, -2.0, 0.5, 0.4, -0.7, 1.9]), np.array([0.1, 0.2, 0.3, 0.01, 0.02, 0.03])
    information = np.diag(1 / sigmas**2)[UPPER]
    (tmp_path / "toro.txt").write_text(f"VERTEX3 4 {text(values)}\nEDGE3 4 5 {text(values)} {text(information)}\n")
    graph = posegraph.read(tmp_path / "toro.txt")
    link = graph.links[0]
    np.testing.assert_allclose(link.i_from_j, geometry.pose(geometry.rotation_from_rpy(0.4, -0.7, 1.9), values[:3]))
    np.testing.assert_array_equal(graph.poses[4], link.i_from_j)
    step = 1e-6
    columns = [
        geometry.so3_log(link.i_from_j[:3, :3].T @ geometry.rotation_from_rpy(*(values[3:] + delta))) / step
        for delta in np.eye(3) * step
    ]
    jacobian = np.column_stack(columns)
    np.testing.assert_allclose(link.cov[:3, :3], jacobian @ np.diag(sigmas[3:] ** 2) @ jacobian.T, atol=1e-8)
    np.testing.assert_allclose(link.cov[3:, 3:], np.diag(sigmas[:3] ** 2), atol=1e-12)
    assert not link.cov[:3, 3:].any()


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("EDGE3 0 1 1 2 3", "has 3 values instead of 6"),
        ("EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1 5 5", "has 2 values instead of 21"),
        ("VERTEX_SE3:QUAT 7 0 0 0", "has 3 values instead of 7"),
        ("VERTEX3 a 0 0 0 0 0 0", "invalid literal"),
    ],
)
def test_a_malformed_line_is_reported_with_its_number(tmp_path, line, problem):
    (tmp_path / "broken.g2o").write_text(f"# a comment\n\n{line}\n")
    with pytest.raises(TwinError, match=f"broken.g2o:3: {re.escape(problem)}"):
        posegraph.read(tmp_path / "broken.g2o")
