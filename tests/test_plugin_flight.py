"""Plug-ins in surveys: controllers, estimators and terrains of another package fly, and faults in them are named."""

import sys

import numpy as np
import pytest

import twin
from twin import survey
from twin.core.records import Trajectory
from twin.errors import ScenarioError, TwinError
from twin.plugin import guard
from twin.plugin.guard import GuardedPlugin, PluginFailed
from twin.world.height_floor import load_terrain
from twin.world.mission import prepare

pytestmark = pytest.mark.long

TINY = [
    "terrain.size_m=[5.0, 4.0]",
    "rig.image_width_px=192",
    "rig.image_height_px=144",
    "rig.frame_rate_hz=15",
    "plan.area_m=[0.3, 0.5]",
    "plan.altitude_m=1.8",
    "control.hold_s=0.4",
]
SURROGATE = ["imaging.fidelity=surrogate", "imaging.extrapolate=true"]
MODULE = '''
import numpy as np

from twin.core import geometry


class Spring:
    """Proportional-derivative control of position and attitude by the thrust allocation of the setup."""

    def __init__(self, setup):
        self.setup = setup

    def wrench(self, estimate, reference):
        body = estimate.world_from_camera @ geometry.inverse(self.setup.rig.body_from_camera)
        twist = geometry.adjoint(self.setup.rig.body_from_camera) @ estimate.camera_velocity
        c, s = np.cos(reference.yaw), np.sin(reference.yaw)
        level = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
        at = reference.position - level @ self.setup.rig.body_from_camera[:3, 3]
        error = geometry.log(geometry.inverse(body) @ geometry.pose(level, at))
        wanted = np.r_[np.zeros(3), body[:3, :3].T @ reference.velocity]
        return self.setup.hull.inertia * (6.0 * error + 4.0 * (wanted - twist))

    def command(self, estimate, reference):
        return self.setup.allocation.commands(self.wrench(estimate, reference))[0]


class Fails(Spring):
    n = 0

    def command(self, estimate, reference):
        self.n += 1
        reference.position[:] = 1e9  # a copy: the plan stays as it is
        return super().command(estimate, reference) if self.n < 20 else self.fail()


class Nan(Fails):
    def fail(self):
        return np.full(8, np.nan)


class Short(Fails):
    def fail(self):
        return np.zeros(6)


class Raises(Fails):
    def fail(self):
        raise ZeroDivisionError("gain")


class NotBuilt(Spring):
    def __init__(self, setup):
        raise LookupError("no gains")


class Dumb:
    def __init__(self, setup):
        pass


class Readings:
    """Dead reckoning by pressure, attitude and the planned start; an estimator without images."""

    truth = None

    def __init__(self, setup):
        self.setup, self.pose, self.n = setup, setup.start, 0

    def update(self, frame):
        assert not hasattr(frame, "truth")
        frame.left[:] = 0  # a copy: the map is made of the images as they were
        self.n += 1
        self.pose = self.pose.copy()
        self.pose[2, 3] = frame.readings.pressure_z_m
        return None if self.n == 5 else self.pose

    def covariance(self):
        return np.diag([1e-6, 1e-6, 1e-6, 1e-4, 1e-4, 1e-4])

    def finish(self):
        return None


class Lost(Readings):
    def update(self, frame):
        pose = super().update(frame)
        return pose if self.n != 12 else 2 * pose


class Dunes:
    def heights(self, x_m, y_m, seed):
        return 0.2 * np.sin(3 * x_m)[None] + 0.1 * y_m[:, None] + 0.001 * seed


class Hole(Dunes):
    def heights(self, x_m, y_m, seed):
        found = super().heights(x_m, y_m, seed)
        found[3, 4] = np.nan
        return found
'''


@pytest.fixture(scope="module", autouse=True)
def _module(tmp_path_factory):
    folder = tmp_path_factory.mktemp("package")
    (folder / "other_package.py").write_text(MODULE)
    sys.path.insert(0, str(folder))
    yield
    sys.path.remove(str(folder))
    sys.modules.pop("other_package", None)


def fly(out, *overrides):
    return survey.run(twin.load_scenario("reef", [*TINY, *overrides], allow_plugins=True), out, outputs=())


def test_a_controller_of_another_package_flies_a_survey(tmp_path):
    result = fly(tmp_path / "run", *SURROGATE, "control.plugin=other_package:Spring")
    assert result.status == "complete"
    assert result.metrics["control"]["cross_track_rmse_m"] < 0.05
    assert "The vehicle was steered by the plug-in other_package:Spring." in result.metrics["warnings"]


@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("Nan", "command returned 8 of 8 numbers that are not finite (expected: finite numbers)"),
        ("Short", "command returned shape (6,) (expected: (8,))"),
        ("Raises", "command raised ZeroDivisionError: gain"),
        ("NotBuilt", "its class raised LookupError: no gains"),
        ("Dumb", "has no method command"),
    ],
)
def test_a_fault_of_a_controller_ends_the_survey_with_its_name(tmp_path, name, reason):
    result = fly(tmp_path / "run", *SURROGATE, f"control.plugin=other_package:{name}")
    assert result.status == "aborted"
    assert result.metrics["reason"].startswith(f"control.plugin other_package:{name}")
    assert result.metrics["reason"].endswith(reason)
    assert (result.folder / "metrics.json").exists()
    planned = Trajectory.load(result.folder / "trajectory_reference.tum")
    assert len(planned) > 0 and np.abs(planned.positions).max() < 3  # the plug-in could not change the plan


def test_every_call_of_a_plugin_without_a_method_names_the_method():
    plugin = GuardedPlugin("terrain.plugin", "twin.terrains", "other_package:Dunes", ["heights", "command"])
    for method in ("command", "heights", "command"):
        with pytest.raises(PluginFailed, match="terrain.plugin other_package:Dunes: has no method command"):
            plugin.call(method, np.zeros(2), np.zeros(2), 1)


def test_an_estimator_of_another_package_is_mapped_and_judged(tmp_path):
    result = fly(tmp_path / "run", "estimate.plugin=other_package:Readings", "plan.speed_mps=0.05", "plan.tracks=1")
    m = result.metrics
    assert result.status == "degraded", m["reason"]  # the vehicle leaves the path that the estimator does not see
    assert m["self_check"]["frames_lost"] == pytest.approx(1 / m["timing"]["frames"])
    assert m["trajectory"]["final"] == m["trajectory"]["online"]
    assert m["trajectory"]["final"]["z_rmse_m"] < 0.02 < m["trajectory"]["final"]["ate_rmse_m"]
    assert m["map"]["completeness"] > 0.4 and m["links"]["along"]["count"] == 0
    assert m["consistency"]["nees_position_mean"] is not None
    assert (result.folder / "dem.tif").exists()


def test_a_fault_of_an_estimator_ends_the_survey_with_its_name(tmp_path):
    result = fly(tmp_path / "run", "estimate.plugin=other_package:Lost")
    assert result.status == "aborted"
    reason = "estimate.plugin other_package:Lost: update returned a matrix that is no rotation"
    assert result.metrics["reason"].startswith(reason)
    assert len((result.folder / "trajectory_online.tum").read_text().splitlines()) == 11


def test_a_floor_of_another_package_has_its_heights_and_a_generated_texture():
    scenario = twin.load_scenario(
        "reef", [*TINY, *SURROGATE, "terrain.plugin=other_package:Dunes", "seed=7"], allow_plugins=True
    )
    floor = load_terrain(scenario)
    for x, y in ((0.0, 0.0), (1.0, -1.4), (-2.2, 1.9)):
        # bilinear interpolation on a grid of 0.04 m: error up to 0.2 * 3^2 * 0.04^2 / 8
        assert floor.height_at(x, y) == pytest.approx(0.2 * np.sin(3 * x) + 0.1 * y + 0.007, abs=4e-4)
    assert floor.texture.std() > 1


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("terrain.plugin=other_package:Hole", "terrain.plugin: other_package:Hole: heights returned 1 of "),
        ("terrain.plugin=other_package:Nothing", "terrain.plugin: other_package:Nothing: AttributeError: "),
        ("control.plugin=other_package:Nothing", "control.plugin: other_package:Nothing: AttributeError: "),
        ("control.plugin=lqr", "control.plugin: lqr: no installed package registers this name in twin.controllers"),
        ("estimate.plugin=other_package:Readings", "estimate.plugin: needs images; the surrogate has none"),
    ],
)
def test_a_plugin_that_cannot_be_used_is_refused_before_the_flight(override, message):
    with pytest.raises(ScenarioError) as refused:
        prepare(twin.load_scenario("reef", [*TINY, *SURROGATE, override], allow_plugins=True))
    assert message in str(refused.value)


@pytest.mark.parametrize("name", ["", "a b", "a:b:c", r"a\nb:C", "/tmp/a.py"])
def test_a_text_that_names_no_plugin_is_refused_by_the_scenario(name):
    with pytest.raises(ScenarioError, match="not allowed .allowed: module:Class, or the name of an entry point"):
        twin.load_scenario("quickstart", [f'control.plugin="{name}"'], allow_plugins=True)


def echo(value):
    """Returns a guarded plug-in, registered as "module:Echo", whose method `give` returns a value."""
    plugin = object.__new__(GuardedPlugin)
    plugin.label, plugin._plugin = "estimate.plugin other:Echo", type("Echo", (), {"give": lambda _: value})()
    return plugin, plugin.call("give")


TURNED = np.eye(4)
TURNED[:2, :2] = [[0, 1], [1, 0]]  # a reflection
SHEARED = np.eye(4)
SHEARED[3, 0] = 1e-3
NOT_FINITE = np.full((4, 4), np.inf)
FAR_AWAY = np.eye(4)
FAR_AWAY[0, 3] = 1e300


class Tensor:
    """Value that cannot become an array, as a tensor of torch with a gradient."""

    def __array__(self, *_, **__):
        raise RuntimeError("call detach")


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (np.eye(3), r"shape \(3, 3\) \(expected: \(4, 4\)\)"),
        ("north", r"str \(expected: numbers of shape"),
        ([[1.0], [2.0, 3.0]], r"list \(expected"),
        (None, r"shape \(\)|NoneType"),
        (NOT_FINITE, "16 of 16 numbers that are not finite"),
        (TURNED, "no rotation"),
        (np.diag([1, 1, 1.001, 1]), "no rotation"),
        (SHEARED, "last row"),
        (FAR_AWAY, r"a position of 1e\+300 m"),
        (Tensor(), r"Tensor \(expected: numbers of shape"),
    ],
)
def test_poses_that_are_not_rigid_are_refused_with_the_name_of_the_plugin(value, message):
    plugin, returned = echo(value)
    with pytest.raises(PluginFailed, match=f"^estimate.plugin other:Echo: give returned .*({message})"):
        plugin.poses("give", returned, (4, 4))


def test_rigid_poses_and_covariances_are_accepted_and_copied():
    plugin, returned = echo(np.stack([np.eye(4)] * 3))
    poses = plugin.poses("give", returned, (3, 4, 4))
    poses[0, 0, 3] = 5.0
    assert returned[0, 0, 3] == 0
    assert plugin.covariance("give", np.diag([0.0, 0, 0, 1, 1, 1])).trace() == 3
    for wrong in (np.diag([1.0, 1, 1, 1, 1, -1]), np.triu(np.ones((6, 6)))):
        with pytest.raises(PluginFailed, match="no covariance"):
            plugin.covariance("give", wrong)


def test_a_floor_that_is_too_high_is_refused(monkeypatch):
    high = type("High", (), {"heights": lambda *_: np.full((2, 3), 2e4)})
    monkeypatch.setattr(guard.loading, "load", lambda *_: high)
    with pytest.raises(TwinError, match="^terrain.plugin: x:High: heights returned a height of 20000 m"):
        guard.terrain_heights("x:High", np.arange(3.0), np.arange(2.0), 0)
