"""A frozen camera is noticed at once; a vehicle at rest under a camera without noise is not taken for one."""

import json
from dataclasses import replace

import numpy as np
import pytest
import recorded_datasets as recorded
import seafloor_scene as scene

from twin import survey
from twin.core.quality import EstimationQuality
from twin.core.records import LEFT_REPEATS, RIGHT_REPEATS, Frame, Readings, SensorNoise
from twin.core.settings import EstimatorSettings
from twin.estimate import Navigator
from twin.estimate.vision.repeated_images import RepeatedImages
from twin.recordings.replay import ReplayOptions, replay
from twin.scenario.file import load_scenario
from twin.world.rendered_world import RenderedWorld

REST, MOVING = np.zeros(6), np.r_[np.zeros(3), 0.3, 0.0, 0.0]
RNG = np.random.default_rng(5)
SCENES = RNG.integers(0, 255, (40, 48, 64, 3), np.uint8)


def statuses(left, right=(), twists=(), readings=(), noisy=True):
    """Returns the statuses of frames with these images, given as indices of `SCENES` (None: no image)."""
    watch, n = RepeatedImages(noisy, SensorNoise()), len(left)
    right, twists = list(right) or [None] * n, list(twists) or [REST] * n
    readings = list(readings) or [Readings()] * n
    frames = [
        Frame(k, k / 30, SCENES[left[k]], None if right[k] is None else SCENES[right[k]], readings[k]) for k in range(n)
    ]
    return [watch.status(frame, twists[k], 1 / 30) for k, frame in enumerate(frames)]


def test_a_repeated_image_of_a_noisy_camera_is_noticed_at_its_first_repetition():
    assert statuses([0, 1, 1, 1, 2]) == ["ok", "ok", LEFT_REPEATS, LEFT_REPEATS, "ok"]


def test_the_right_camera_is_frozen_until_it_delivers_a_new_image():
    found = statuses(range(6), right=[0, None, 0, None, 3, None])
    assert found == ["ok", "ok", RIGHT_REPEATS, RIGHT_REPEATS, "ok", "ok"]


def test_noise_of_a_hundredth_of_a_grey_level_is_no_repetition():
    watch = RepeatedImages(True, SensorNoise())
    scene = RNG.uniform(0, 250, (200, 300, 3))
    images = [np.rint(scene + RNG.normal(0, 0.01, scene.shape)).astype(np.uint8) for _ in range(5)]
    assert {watch.status(Frame(k, k / 30, image, None), MOVING, 1 / 30) for k, image in enumerate(images)} == {"ok"}


def test_images_in_memory_that_the_caller_uses_again_are_no_repetition():
    watch, memory = RepeatedImages(True, SensorNoise()), np.zeros((48, 64, 3), np.uint8)
    for k in range(4):
        memory[:] = SCENES[k]
        assert watch.status(Frame(k, k / 30, memory, None), MOVING, 1 / 30) == "ok"


def noisy(sigma, n=12, shape=()):
    return RNG.normal(0.0, sigma, (n, *shape))


STILL = [
    Readings(2.0 + float(z), rpy, v)
    for z, rpy, v in zip(noisy(0.01), noisy(np.deg2rad(0.2), shape=(3,)), noisy(0.005, shape=(3,)), strict=True)
]


def test_a_vehicle_at_rest_under_a_camera_without_noise_is_measured():
    """Its images are equal bit for bit; noise of the sensors is not motion."""
    assert set(statuses([0] * 12, noisy=False)) == {"ok"}
    assert set(statuses([0] * 12, readings=STILL, noisy=False)) == {"ok"}


@pytest.mark.parametrize(
    "readings",
    [
        [Readings(dvl_mps=np.array([0.1, 0.0, 0.0]))] * 12,
        [Readings(pressure_z_m=2.0 + 0.01 * k) for k in range(12)],
        [Readings(ahrs_rpy_rad=np.array([0.0, 0.0, 3.1 + 0.01 * k])) for k in range(12)],
    ],
    ids=["dvl", "pressure", "ahrs"],
)
def test_sensors_reveal_a_frozen_camera_without_noise(readings):
    found = statuses([0] * 12, readings=readings, noisy=False)
    assert found[0] == "ok" and found[-1] == LEFT_REPEATS


def test_a_vehicle_cannot_stop_between_two_frames():
    """The camera stays frozen while the predicted velocity decays."""
    found = statuses([0, 1, 1, 1], twists=[MOVING, MOVING, MOVING, REST], noisy=False)
    assert found == ["ok", "ok", LEFT_REPEATS, LEFT_REPEATS]


def test_a_frozen_right_camera_does_not_hide_that_the_left_one_is_lost():
    rig, floor, rng = scene.small_rig(160, 120), scene.plane(0.05, 0.03), np.random.default_rng(0)
    frozen = []
    with Navigator(rig, settings=EstimatorSettings(noisy_images=True)) as navigator:
        for k in range(10):
            pair = scene.stereo_pair(floor, rig, scene.down_camera(0.02 * k, 0, 2.0), rng)[:2]
            left, right = (np.repeat(image[..., None], 3, axis=2) for image in pair)
            frozen = [right, *frozen][:1] if k < 4 else frozen
            left = rng.integers(0, 255, left.shape, dtype=np.uint8) if k >= 7 else left
            estimate = navigator.update(Frame(k, k / 30, left, frozen[0]))
            assert estimate.is_measured == (k < 7)
            assert estimate.status.startswith(RIGHT_REPEATS) == (k >= 4)
        quality = navigator.finish().quality
    assert quality.frames_lost == 3 and sorted(len(rows) for rows in quality.repeats.values()) == [3, 3]


def test_notes_name_the_frames():
    quality = EstimationQuality(repeats={LEFT_REPEATS: [3, 4, 5, 9]})
    assert quality.repeat_notes == [
        "The left camera repeats its image in 4 frames (3 to 5, 9); these images were not used."
    ]
    assert EstimationQuality().repeat_notes == []


@pytest.mark.long
def test_a_replay_names_the_repeated_frames_of_a_recording(tmp_path):
    frames = recorded.frames(recorded.poses(12))
    frames[6:8] = [replace(frame, left=frames[5].left, right=frames[5].right) for frame in frames[6:8]]
    folder = recorded.write_folder(tmp_path / "data", frames)
    metrics = replay(folder, tmp_path / "run", ReplayOptions(outputs=())).metrics
    assert metrics["status"] == "degraded" and f"{LEFT_REPEATS} in 2 of 12 frames" in metrics["reason"]
    assert any("(6 to 7)" in text for text in metrics["warnings"])


@pytest.mark.long
def test_a_survey_whose_camera_freezes_holds_and_ends_with_that_reason(tmp_path, monkeypatch):
    """Within half a second; the vehicle then stays within a tenth of its footprint of the plan."""
    capture, last = RenderedWorld.capture, {}

    def frozen(world, step):
        images = capture(world, step)
        if len(world) / world.mission.rig.frame_rate_hz < 2.0:
            last["left"] = images.left
        return images._replace(left=last["left"])

    monkeypatch.setattr(RenderedWorld, "capture", frozen)
    small = ["terrain.size_m=[6.0, 4.0]", "rig.image_width_px=192", "rig.image_height_px=144", "plan.tracks=1"]
    more = ["rig.frame_rate_hz=15", "plan.area_m=[2.0,0.6]", "plan.altitude_m=1.8", "control.hold_s=0.4"]
    result = survey.run(load_scenario("reef", [*small, *more]), tmp_path, outputs=None)
    reason, events = result.metrics["reason"], [json.loads(line) for line in (tmp_path / "log.jsonl").open()]
    first = next(event for event in events if event.get("status") == LEFT_REPEATS)
    assert result.status == "aborted" and reason.endswith(LEFT_REPEATS) and "water" not in reason
    assert first["time_s"] < 2.1 and [e["action"] for e in events if e["event"] == "action"] == ["hold"]
    assert [event["reason"] for event in events if event["event"] == "flight ended early"] == [reason]
    assert any(text.startswith(LEFT_REPEATS.capitalize()) for text in result.metrics["warnings"])
    assert result.metrics["control"]["cross_track_rmse_m"] < 0.1
