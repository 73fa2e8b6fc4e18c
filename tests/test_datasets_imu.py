"""Replays whose motion between frames is predicted by the recorded IMU."""

from dataclasses import replace

import numpy as np
import pytest
import recorded_datasets as recorded
from recorded_datasets import RIG

import twin
from twin.core import geometry
from twin.core.records import ImuReadings
from twin.datasets import sensor_folders
from twin.datasets.run_contents import ImuNoise, RecordedImu
from twin.errors import TwinError
from twin.recordings.replay import ReplayOptions

pytestmark = pytest.mark.long

N, RATE_HZ, BLIND = 30, 200.0, range(14, 20)


def position_m(t):
    """Returns x of the camera: it starts at rest, and turns round while it is blind."""
    return -0.2 + 0.09 * (1 - np.cos(1.1 * t))


def recorded_with_imu(folder):
    """Writes an EuRoC folder with black frames, true poses and an IMU at the origin of the body."""
    times_s = np.arange(N) / RIG.frame_rate_hz
    path = np.array([scene_pose(position_m(t)) for t in times_s])
    frames = recorded.frames(path)
    for k in BLIND:
        frames[k] = replace(frames[k], left=np.zeros_like(frames[k].left), right=np.zeros_like(frames[k].right))
    recorded.write_euroc(folder, frames, path)
    fine_s = np.arange(round(times_s[-1] * RATE_HZ) + 1) / RATE_HZ
    body = path[0] @ geometry.inverse(RIG.body_from_camera)
    along = np.zeros((len(fine_s), 3))
    along[:, 0] = 0.09 * 1.1**2 * np.cos(1.1 * fine_s)
    rng = np.random.default_rng(5)
    forces = (along + [0, 0, 9.81]) @ body[:3, :3] + [0.05, -0.08, 0.03] + 0.03 * rng.standard_normal(along.shape)
    rates = np.array([0.01, -0.02, 0.015]) + 0.002 * rng.standard_normal(along.shape)
    imu = RecordedImu(ImuReadings(fine_s, rates, forces), RATE_HZ, ImuNoise(2e-4, 2e-5, 2e-3, 3e-3))
    sensor_folders._write_imu(folder / "mav0" / "imu0", imu)
    return folder, path


def scene_pose(x):
    return recorded.scene.down_camera(x, 0.0, 1.6, (0.02, 0.0, 0.1))


def test_a_recorded_imu_bridges_black_frames(tmp_path):
    folder, path = recorded_with_imu(tmp_path / "set")
    largest_m = {}
    for imu in (False, True):
        options = ReplayOptions(start=path[0], outputs=(), imu=imu)
        found = twin.replay(folder, tmp_path / f"run-{imu}", options)
        online = found.result.online.positions
        largest_m[imu] = np.linalg.norm(online - path[: len(online), :3, 3], axis=1)[BLIND.start :].max()
        assert ("imu" in found.metrics["replay"]["aiding"]) is imu
        print(imu, largest_m, found.metrics["replay"]["aiding"], found.metrics["self_check"]["frames_lost"])
    assert largest_m[True] < 0.4 * largest_m[False] and largest_m[True] < 0.02


def test_an_imu_away_from_the_body_or_missing_is_named(tmp_path):
    folder, _ = recorded_with_imu(tmp_path / "set")
    file = folder / "mav0" / "imu0" / "sensor.yaml"
    text = file.read_text()
    file.write_text(text.replace("data: [1.0, 0.0, 0.0, 0.0", "data: [1.0, 0.0, 0.0, 0.3", 1))
    assert file.read_text() != text
    with pytest.raises(TwinError, match="no readings of an IMU at the origin of the body"):
        twin.replay(folder, tmp_path / "away", ReplayOptions(imu=True))
    plain = recorded.write_euroc(tmp_path / "plain", recorded.frames(recorded.poses(3)), recorded.poses(3))
    with pytest.raises(TwinError, match="--imu"):
        twin.replay(plain, tmp_path / "missing", ReplayOptions(imu=True))
