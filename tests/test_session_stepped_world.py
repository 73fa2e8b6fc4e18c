"""`twin.World`: a loop of a program flies the same survey as `twin.run`, bit for bit."""

import ast
import runpy
import sys
from pathlib import Path

import numpy as np
import pytest

import twin
from twin import survey
from twin.errors import TwinError

pytestmark = pytest.mark.long

EXAMPLE = Path(__file__).parent.parent / "docs" / "example_world.py"
TINY = [
    "terrain.size_m=[5.0, 4.0]",
    "rig.image_width_px=192",
    "rig.image_height_px=144",
    "rig.frame_rate_hz=15",
    "plan.area_m=[0.3, 0.5]",
    "plan.altitude_m=1.8",
    "control.hold_s=0.4",
]


def tiny(*overrides):
    return twin.load_scenario("reef", [*TINY, *overrides])


@pytest.mark.parametrize("fidelity", ["rendered", "surrogate"])
def test_the_example_writes_the_same_trajectories_as_a_run(tmp_path, monkeypatch, fidelity):
    overrides = [*TINY, f"imaging.fidelity={fidelity}", "imaging.extrapolate=true"]
    monkeypatch.setattr(sys, "argv", ["example_world.py", str(tmp_path / "loop"), "reef", *overrides])
    runpy.run_path(str(EXAMPLE), run_name="__main__")
    survey.run(tiny(*overrides), tmp_path / "run", outputs=())
    for name in ("truth", "f2f", "online", "final"):
        file = f"trajectory_{name}.tum"
        assert (tmp_path / "loop" / file).read_bytes() == (tmp_path / "run" / file).read_bytes(), name
    assert len((tmp_path / "loop" / "trajectory_online.tum").read_text().splitlines()) > 60


def test_the_loop_of_the_example_has_at_most_15_lines():
    loop = next(node for node in ast.parse(EXAMPLE.read_text()).body if isinstance(node, ast.With))
    assert loop.end_lineno - loop.lineno + 1 <= 15


def test_one_seed_and_the_same_commands_give_the_same_frames_and_extra_pairs_change_nothing():
    rng = np.random.default_rng(0)
    commands = rng.uniform(-0.3, 0.3, (4, 8))

    def fly(world, seed, capture):
        frames, pairs = [world.reset(seed)], []
        for command in commands:
            if capture:
                pairs.append(world.capture())
            frames.append(world.step(command))
        return frames, pairs

    with twin.World(tiny("sensor={}", "snow.density_per_m3=300.0")) as world:
        plain, _ = fly(world, 5, False)
        watched, pairs = fly(world, 5, True)
        other, _ = fly(world, 6, False)
    for a, b, c in zip(plain, watched, other, strict=True):
        np.testing.assert_array_equal(a.left, b.left)
        assert a.readings.pressure_z_m == b.readings.pressure_z_m != c.readings.pressure_z_m
        assert a.time_s == b.time_s and a.exposure == b.exposure
    for frame, pair in zip(watched, pairs, strict=False):
        difference = np.abs(frame.left.astype(float) - pair.left)
        assert 0.1 < difference.mean() < 8  # the same view with other noise
    assert not np.array_equal(plain[0].left, other[0].left)


def test_a_program_chooses_keyframes_and_the_flight_ends_with_the_plan():
    with twin.World(tiny("imaging.fidelity=surrogate", "imaging.extrapolate=true")) as world:
        frame = world.reset()
        assert frame.keyframe and frame.right is not None
        for wrong in (np.zeros(6), np.zeros(9), 0.0):
            with pytest.raises(ValueError, match=r"shape .* \(expected: \(8,\)\)"):
                world.step(wrong)
        frame, n = world.step(np.zeros(8), keyframe=True), 1
        assert frame.right is not None
        frame, n = world.step(np.zeros(8), keyframe=False), 2
        assert frame.right is None
        while frame is not None:
            frame, n = world.step(np.zeros(8)), n + 1
        assert n == world.mission.n_frames == len(world.truth().trajectory)
        with pytest.raises(RuntimeError, match="all frames of the plan have been flown"):
            world.step(np.zeros(8))
        with pytest.raises(TwinError, match="the surrogate has no images"):
            world.capture()


def test_a_world_before_its_reset_and_after_its_end_refuses_to_step():
    world = twin.World(tiny("imaging.fidelity=surrogate", "imaging.extrapolate=true"))
    with pytest.raises(RuntimeError, match="call reset first"):
        world.step(np.zeros(8))
    world.reset()
    world.close()
    with pytest.raises(RuntimeError, match="call reset first"):
        world.truth()


@pytest.mark.parametrize("seed", [-1, 2**70, 2.5])
def test_a_seed_out_of_range_is_refused_before_the_flight_ends(seed):
    with twin.World(tiny("imaging.fidelity=surrogate", "imaging.extrapolate=true")) as world:
        world.reset(3)
        with pytest.raises(TwinError, match="seed: .*allowed: a whole number from 0 to 4294967295"):
            world.reset(seed)
        assert world.step(np.zeros(8)) is not None
