"""Checked calls of plug-ins: what is refused, what is let through, and that arguments cannot be changed."""

import numpy as np
import pytest

from twin.core import geometry
from twin.errors import TwinError
from twin.plugin import loading
from twin.plugin.guard import GuardedPlugin, PluginFailed, terrain_heights

POSE = geometry.exp(np.array([0.1, -0.2, 0.3, 1.0, 2.0, -3.0]))


class Recorder:
    """Plug-in whose methods answer, change their argument, or raise."""

    created = 0

    def __init__(self, start):
        type(self).created += 1
        self.start = start

    def change(self, values):
        values += self.start
        return values

    def crash(self):
        raise SystemExit(3)

    def heights(self, x_m, y_m, seed):
        return np.add.outer(y_m, x_m) * seed


class NoHeights:
    """Terrain without its method."""


class Broken:
    """Plug-in whose class raises."""

    def __init__(self):
        raise ValueError("no licence")


@pytest.fixture
def guarded(monkeypatch):
    """Returns a function that guards a class of this module."""
    monkeypatch.setattr(loading, "load", lambda key, group, name: globals()[name])
    return lambda name, *arguments, methods=("change",): GuardedPlugin(
        "control.plugin", "group", name, methods, *arguments
    )


@pytest.fixture
def guard(guarded):
    return guarded("Recorder", 1.0)


def test_a_plug_in_is_created_once_and_gets_copies(guard):
    before, values = Recorder.created, np.zeros(3)
    for _ in range(2):
        np.testing.assert_array_equal(guard.call("change", values), np.ones(3))
    np.testing.assert_array_equal(values, np.zeros(3))
    assert Recorder.created == before + 1


@pytest.mark.parametrize(
    ("name", "methods", "method", "message"),
    [
        ("Recorder", ("change",), "crash", "control.plugin Recorder: crash raised SystemExit"),
        ("Recorder", ("change", "update"), "change", "control.plugin Recorder: has no method update"),
        ("Broken", (), "change", "control.plugin Broken: its class raised ValueError: no licence"),
    ],
)
def test_a_failure_of_the_plug_in_names_it(guarded, name, methods, method, message):
    plugin = guarded(name, *([1.0] if name == "Recorder" else []), methods=methods)
    with pytest.raises(PluginFailed, match=message):
        plugin.call(method)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        ([1.0, 2.0], r"shape \(2,\) \(expected: \(3,\)\)"),
        (["a", "b", "c"], "returned list"),
        ([1.0, np.nan, np.inf], "2 of 3 numbers that are not finite"),
    ],
)
def test_numbers_have_their_shape_and_are_finite(guard, value, message):
    np.testing.assert_array_equal(guard.numbers("update", [1, 2, 3], (3,)), [1.0, 2.0, 3.0])
    with pytest.raises(PluginFailed, match=message):
        guard.numbers("update", value, (3,))


def changed(matrix, at, by):
    matrix = matrix.copy()
    matrix[at] += by
    return matrix


@pytest.mark.parametrize(
    ("pose", "message"),
    [
        (changed(POSE, (0, 0), 2e-6), "no rotation"),
        (POSE @ np.diag([1.0, 1.0, -1.0, 1.0]), "no rotation"),
        (changed(POSE, (3, 0), 1e-9), "last row"),
        (changed(POSE, (1, 3), -2e6), "a position of 2e.06 m .expected: up to 1e.06 m"),
    ],
)
def test_poses_are_rigid_and_within_reach(guard, pose, message):
    np.testing.assert_array_equal(guard.poses("update", [POSE, POSE], (2, 4, 4)), [POSE, POSE])
    np.testing.assert_array_equal(guard.poses("update", changed(POSE, (1, 3), -9e5), (4, 4))[1, 3], POSE[1, 3] - 9e5)
    for value in (pose, np.stack([POSE, pose])):
        with pytest.raises(PluginFailed, match=message):
            guard.poses("update", value, value.shape)


@pytest.mark.parametrize(
    "matrix",
    [changed(np.eye(6), (0, 1), 1e-8), np.diag([1.0, 1.0, 1.0, 1.0, 1.0, -1e-8])],
    ids=["asymmetric", "negative"],
)
def test_a_covariance_is_symmetric_and_positive_semidefinite(guard, matrix):
    for good in (np.eye(6), np.zeros((6, 6)), np.ones((6, 6)), 1e-12 * np.eye(6)):
        np.testing.assert_array_equal(guard.covariance("update", good), good)
    for scale in (1.0, 1e-6):
        with pytest.raises(PluginFailed, match="no covariance"):
            guard.covariance("update", scale * matrix)


def test_heights_of_a_terrain_are_checked_and_an_error_names_the_key(guarded, monkeypatch):
    monkeypatch.setitem(globals(), "Recorder", type("Recorder", (Recorder,), {"__init__": lambda self: None}))
    x_m, y_m = np.array([0.0, 1.0, 2.0]), np.array([0.0, 10.0])
    np.testing.assert_array_equal(terrain_heights("Recorder", x_m, y_m, 2), [[0, 2, 4], [20, 22, 24]])
    with pytest.raises(TwinError, match="terrain.plugin: Recorder: heights returned a height of 12000 m"):
        terrain_heights("Recorder", x_m, y_m, 1000)
    with pytest.raises(TwinError, match="has no method heights"):
        terrain_heights("NoHeights", x_m, y_m, 1)
