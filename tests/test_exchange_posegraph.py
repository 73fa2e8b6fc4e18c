"""Pose graph files: both formats give the same motions and covariances, and written files are read back."""

import re
import time
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


POSE = "0 0 0 0 0 0 1"
UNIT = text(np.eye(6)[UPPER])


def written(tmp_path, content):
    file = tmp_path / "graph.g2o"
    file.write_bytes(content if isinstance(content, bytes) else content.encode())
    return file


def edge(i, j, information=UNIT, pose=POSE):
    return f"EDGE_SE3:QUAT {i} {j} {pose} {information}\n"


def information(matrix):
    return text(np.asarray(matrix)[UPPER])


def indefinite():
    matrix = np.eye(6)
    matrix[0, 1] = matrix[1, 0] = 2.0
    return information(matrix)


@pytest.mark.parametrize(
    ("line", "problem"),
    [
        ("EDGE3 0 1 1 2 3", "has 3 values instead of 27"),
        ("EDGE_SE3:QUAT 0 1 0 0 0 0 0 0 1 5 5", "has 9 values instead of 28"),
        ("VERTEX_SE3:QUAT 7 0 0 0", "has 3 values instead of 7"),
        ("VERTEX_SE3:QUAT", "has 0 values instead of 7"),
        ("VERTEX3 a 0 0 0 0 0 0", "'a' is not a node number"),
        ("VERTEX3 1.5 0 0 0 0 0 0", "'1.5' is not a node number"),
        (f"VERTEX3 {'9' * 30} 0 0 0 0 0 0", f"'{'9' * 30}' is not a node number"),
        ("VERTEX3 1 0 0 0 0 0 0x", "'0x' is not a number"),
        ("VERTEX3 1 0 0 nan 0 0 0", "value 3 is nan"),
        ("VERTEX3 1 0 0 0 -inf 0 0", "value 4 is -inf"),
        (edge(0, 1, UNIT.replace("1", "nan", 1)), "value 8 is nan"),
        (edge(0, 1, indefinite()), "the information matrix is indefinite: its least eigenvalue is -1"),
        (edge(0, 1, information(-np.eye(6))), "the information matrix is indefinite: its least eigenvalue is -1"),
        (edge(0, 1, information(np.diag([1, 1, 1, 1, 1, 0]))), "the information matrix is singular"),
        (edge(0, 1, information(np.ones((6, 6)))), "the information matrix is singular"),
        (edge(0, 1, pose="0 0 0 0 0 0 0"), "the quaternion has the length 0"),
        (edge(0, 1, pose="0 0 0 0 0 1 1"), "the quaternion has the length 1.41"),
        (edge(3, 3), "joins node 3 with itself"),
        (f"VERTEX3 1 0 0 0 0 {np.pi / 2} 0", "the pitch is 90 deg"),
        (f"VERTEX_SE3:QUAT 1 {POSE}\nVERTEX3 1 0 0 0 0 0 0", "node 1 is defined twice"),
        (f"VERTEX_SE3:QUAT 1 {POSE}\nVERTEX_SE3:QUAT 1 {POSE}", "node 1 is defined twice"),
    ],
)
def test_a_malformed_line_is_reported_with_its_number(tmp_path, line, problem):
    number = 2 + len(line.strip().splitlines())
    with pytest.raises(TwinError, match=f"graph.g2o:{number}: {re.escape(problem)}"):
        posegraph.read(written(tmp_path, f"# a comment\n\n{line}\n{edge(8, 9)}"))


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", ": has no vertex and no edge"),
        (b"\n# only a comment\n", ": has no vertex and no edge"),
        (b"\nVERTEX_SE2 0 0 0 0\n", ":2: 1 line with the unknown tag 'VERTEX_SE2' is ignored"),
        (b"\n\xff\xff\n", ":2: is not UTF-8"),
        ("VERTEX3 0 0 0 0 0 0 0\n".encode("utf-16"), ":1: is UTF-16"),
    ],
)
def test_a_file_that_is_no_pose_graph_is_reported(tmp_path, content, problem):
    with pytest.raises(TwinError, match=f"graph.g2o{re.escape(problem)}"):
        posegraph.read(written(tmp_path, content))


@pytest.mark.parametrize("name", ["missing.g2o", "a\0b", "n" * 300, ""])
def test_a_path_that_is_no_file_is_reported(tmp_path, name):
    with pytest.raises(TwinError, match="does not exist|cannot be read|is not a regular file"):
        posegraph.read(tmp_path / name)


def test_a_byte_order_mark_does_not_hide_the_first_line(tmp_path):
    graph = posegraph.read(written(tmp_path, f"\ufeffVERTEX_SE3:QUAT 4 {POSE}\n"))
    assert list(graph.poses) == [4] and not graph.ignored


def test_lines_with_unknown_tags_are_counted_and_named(tmp_path):
    content = f"FIX 0\n{edge(0, 1)}EDGE_SE2 0 1 0 0 0 1 0 0 1 0 1\nEDGE_SE2 1 2 0 0 0 1 0 0 1 0 1\n"
    graph = posegraph.read(written(tmp_path, content))
    assert [tuple(lines) for lines in graph.ignored] == [("FIX", 1, 1), ("EDGE_SE2", 2, 3)]
    assert graph.warnings[1].endswith("graph.g2o:3: 2 lines with the unknown tag 'EDGE_SE2' are ignored")
    assert len(graph.warnings) == 2


def test_isolated_undefined_and_separate_nodes_are_named_with_their_lines(tmp_path):
    vertices = "".join(f"VERTEX_SE3:QUAT {k} {POSE}\n" for k in (0, 1, 2, 7))
    graph = posegraph.read(written(tmp_path, vertices + edge(0, 1) + edge(1, 2) + edge(5, 6)))
    isolated, undefined, separate = (warning.partition("graph.g2o:")[2] for warning in graph.warnings)
    assert isolated == "4: node 7 is in no edge"
    assert undefined == "7: nodes 5, 6 are in an edge, but without a vertex"
    assert separate == "7: 2 nodes, the first of them 5, have no edge to the component of node 0"
    assert len(graph.poses) == 4 and len(graph.links) == 3


@pytest.mark.parametrize("scale", [1e-6, 1.0, 1e12])
def test_definite_information_of_any_scale_is_read(tmp_path, scale):
    """Rotation and translation have different units: a scale of one of them makes no matrix indefinite."""
    root = np.random.default_rng(1).normal(size=(6, 6)) * np.repeat([1.0, scale], 3)[:, None]
    matrix = root @ root.T
    cov = posegraph.read(written(tmp_path, edge(0, 1, " ".join(f"{v:.17g}" for v in matrix[UPPER])))).links[0].cov
    unit = 1 / np.sqrt(np.diag(matrix))
    expected = unit[:, None] * np.linalg.inv(matrix * np.outer(unit, unit)) * unit
    order = [3, 4, 5, 0, 1, 2]
    np.testing.assert_allclose(cov, expected[np.ix_(order, order)], rtol=1e-6)


def test_a_graph_is_read_at_most_three_times_as_slowly_as_by_gtsam(tmp_path):
    gtsam = pytest.importorskip("gtsam")
    rng = np.random.default_rng(0)
    poses = np.column_stack([rng.normal(size=(3000, 3)), rng.normal(size=(3000, 4))])
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    file = written(tmp_path, "".join(edge(k, k + 1, UNIT, text(pose)) for k, pose in enumerate(poses)))
    ratios = []
    for _ in range(8):  # the best of eight: other processes disturb single runs
        start = time.process_time()
        graph, _ = gtsam.readG2o(str(file), True)
        middle = time.process_time()
        links = posegraph.read(file).links
        ratios.append((time.process_time() - middle) / (middle - start))
    assert len(links) == graph.size() == 3000
    assert min(ratios) < 3, ratios
