"""The Gymnasium environment: gymnasium's own checker, its rewards and its ends."""

import importlib
import sys
import warnings
from dataclasses import replace

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

import twin.gym
from twin.core import geometry
from twin.core.records import Readings
from twin.errors import TwinError
from twin.scenario.model import VehicleConfig
from twin.simulate.autopilot import nominal_controller

pytestmark = pytest.mark.long

SMALL = [
    "terrain.size_m=[4.0, 3.5]",
    "terrain.kind=flat",
    "terrain.texture_px_m=0.01",
    "rig.image_width_px=64",
    "rig.image_height_px=48",
    "rig.frame_rate_hz=10",
    "plan.area_m=[0.3, 0.5]",
    "plan.altitude_m=1.5",
    "plan.overlap_along=0.7",
    "control.hold_s=0.2",
    "water.jerlov=clear",
    "map.cell_m=0.05",
]


def make(*overrides, **options):
    return gymnasium.make("twin.gym:SeabedTwin-v0", scenario="reef", overrides=[*SMALL, *overrides], **options)


def test_the_environment_passes_the_checker_of_gymnasium():
    env = make(render_mode="rgb_array")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.filterwarnings("ignore", message=".*(infinity|Box observation space).*")
        check_env(env.unwrapped, skip_render_check=True)
    env.reset(seed=1)
    assert env.render().shape == (48, 128, 3)
    env.close()


def test_an_episode_that_follows_the_plan_covers_the_area_and_ends_with_the_plan():
    area_m2 = 1.8 * 0.6
    env = make("plan.area_m=[1.8, 0.6]")
    observation, info = env.reset(seed=3)
    assert env.observation_space.contains(observation)
    np.testing.assert_allclose(observation["pose"][:3], info["truth"]["world_from_camera"][:3, 3], atol=1e-4)
    assert set(observation) == {"left", "right", "readings", "available", "pose", "reference"}
    first, truncated, rewards = info["truth"]["covered"], False, []
    assert first < 0.8
    while not truncated:
        # the true position: images of 64 px are too small for the estimators; the bow points along x
        error = observation["reference"][:3] - info["truth"]["world_from_camera"][:3, 3]
        action = np.append(np.clip(error, -1, 1), 0.0).astype(np.float32)
        observation, reward, terminated, truncated, info = env.step(action)
        rewards.append(reward)
        assert not terminated, info["ended"]
    assert min(rewards) >= 0
    # the area is counted in cells of 0.05 m: an error of half a cell along its border of 4.8 m
    assert sum(rewards) == pytest.approx((info["truth"]["covered"] - first) * area_m2, abs=4.8 * 0.025)
    assert info["truth"]["covered"] > 0.9
    env.close()


def test_an_area_without_a_cell_is_covered():
    env = make("plan.area_m=[0.5, 0.5]", "map.cell_m=1.0")
    assert env.reset(seed=1)[1]["truth"]["covered"] == 1.0
    env.close()


def test_the_controller_of_an_episode_sees_the_thruster_monitor():
    lost = ['faults=[{part="thruster",number=2,start_s=0.0}]', "control.thruster_feedback=speed"]
    env = make(*lost, action="velocity")
    env.reset(seed=1)
    assert env.unwrapped._steer._monitor is env.unwrapped.world.world.thruster_monitor
    env.close()


def test_a_velocity_moves_the_target_in_the_axes_of_the_vehicle():
    """Forward, left and up, at a heading of 90 deg after a quarter turn: forward is north, left is west."""
    env = make()
    env.reset(seed=1)
    inner = env.unwrapped
    for yaw, forward, left in ((0.0, [1, 0, 0], [0, 1, 0]), (np.pi / 2, [0, 1, 0], [-1, 0, 0])):
        for action, direction in (([1, 0, 0, 0], forward), ([0, 1, 0, 0], left), ([0, 0, 1, 0], [0, 0, 1])):
            before = inner._target._replace(yaw=yaw)
            inner._target = before
            inner._command(np.array(action, float))
            moved = inner._target.position - before.position
            np.testing.assert_allclose(moved / np.linalg.norm(moved), direction, atol=1e-12)
    env.close()


def test_thrust_towards_the_floor_ends_the_episode_with_a_reason():
    env = make(action="thrust", reward="track")
    _, info = env.reset(seed=3)
    assert info["truth"]["distance_to_plan_m"] == pytest.approx(0, abs=1e-9)
    down = nominal_controller(VehicleConfig(), 1.2, 10).allocation.commands(np.array([0, 0, 0, 0, 0, -100.0]))[0]
    terminated = truncated = False
    while not (terminated or truncated):
        _, reward, terminated, truncated, info = env.step(down.astype(np.float32))
        assert reward == pytest.approx(-info["truth"]["distance_to_plan_m"])
    assert terminated and info["ended"].startswith("contact of the hull with the floor at ")
    assert info["truth"]["distance_to_plan_m"] > 0.1
    env.close()


def test_a_step_lasts_to_the_next_planned_keyframe_over_the_drawn_floor():
    """The plan keeps the overlap over the floor: 12 frames per keyframe with the seed of the scenario, 6 with this."""
    env = make("terrain.kind=reef", "terrain.relief_m=0.8", "plan.altitude_m=1.2")
    env.reset(seed=4)
    *_, info = env.step(np.zeros(4, np.float32))
    assert info["time_s"] == pytest.approx(6 / 10)
    assert env.unwrapped.frames_per_step == 6
    env.close()


@pytest.mark.parametrize(("status", "corrected_m"), [("ok", 0.5), ("too few matches", 0.0)])
def test_a_position_that_was_predicted_without_vision_is_not_corrected(status, corrected_m):
    """As in a survey: the deviation of a predicted position from the reference is unknown."""
    env = make()
    env.reset(seed=3)
    inner, seen = env.unwrapped, []
    pose = inner._estimate.world_from_camera + geometry.pose(np.eye(3), np.array([0.5, 0, 0])) - np.eye(4)
    inner._estimate = inner._estimate._replace(world_from_camera=pose, status=status)
    inner._frame = replace(inner._frame, readings=Readings())
    inner._steer = lambda estimate, target: seen.append(estimate.world_from_camera[:3, 3] - target.position)
    inner._command(np.zeros(4))
    np.testing.assert_allclose(seen[0], [corrected_m, 0, 0], atol=1e-5)  # noise of the first estimate
    env.close()


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"action": "torque"}, "action: 'torque'"),
        ({"reward": "fun"}, "reward: 'fun'"),
        ({"overrides": ["imaging.fidelity=surrogate"]}, "imaging.fidelity: 'surrogate' has no images"),
        ({"action": "thrust", "overrides": ["vehicle.dynamics=kinematic"]}, "action: 'thrust'"),
    ],
)
def test_options_that_cannot_be_used_are_refused(options, message):
    with pytest.raises(TwinError, match=message):
        twin.gym.SeabedTwinEnv(**options)


def test_without_gymnasium_the_import_says_which_extra_to_install(monkeypatch):
    monkeypatch.setitem(sys.modules, "gymnasium", None)
    monkeypatch.delitem(sys.modules, "twin.gym")
    with pytest.raises(ImportError, match=r"^twin.gym needs the package gymnasium: pip install 'seabed-twin\[gym\]'"):
        importlib.import_module("twin.gym")


def state_env(*overrides, **options):
    name = "twin.gym:SeabedTwinState-v0"
    return gymnasium.make(name, scenario="reef", overrides=[*SMALL, *overrides], disable_env_checker=True, **options)


def test_the_environment_without_images_passes_the_checker_and_follows_the_plan():
    env = state_env("plan.area_m=[1.8, 0.6]", observe=("pose", "velocity", "reference", "readings", "available"))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        check_env(env.unwrapped, skip_render_check=True)
    state, _ = env.reset(seed=1)
    truncated, rewards = False, []
    while not truncated:
        ahead = (state["reference"][:3] - state["pose"][:3]) * 4.0
        action = np.append(np.clip(ahead, -1, 1), 0.0).astype(np.float32)
        state, reward, terminated, truncated, _ = env.step(action)
        rewards.append(reward)
        assert not terminated and env.observation_space.contains(state)
    assert np.mean(rewards) > -0.3


def test_contact_ends_an_episode_without_images_and_rewards_can_be_given():
    env = state_env(action="thrust", frames=5, reward=lambda one: -one.world.true_pose[2, 3])
    env.reset(seed=1)
    for sense in (-1, 1):  # one of the two directions of the vertical thrusters is down
        command = np.array([0, 0, 0, 0, sense, sense, sense, sense], np.float32)
        for _ in range(60):
            _, reward, terminated, truncated, info = env.step(command)
            if terminated or truncated:
                break
        if terminated:
            break
        env.reset(seed=1)
    assert terminated and "contact of the hull with the floor" in info["ended"] and -1.5 < reward < 0


@pytest.mark.parametrize(("options", "message"), [
    ({"observe": ("left",)}, "observe"), ({"frames": 0}, "frames"), ({"reward": "coverage"}, "reward: 'coverage'"),
])  # fmt: skip
def test_options_of_the_environment_without_images_are_checked(options, message):
    with pytest.raises(TwinError, match=message):
        state_env(**options)


def test_the_availability_of_readings_is_observed_without_them():
    both, alone = (
        state_env(observe=observe).reset(seed=1)[0] for observe in (("available", "readings"), ("available",))
    )
    assert both["available"].any() and np.array_equal(both["available"], alone["available"])
