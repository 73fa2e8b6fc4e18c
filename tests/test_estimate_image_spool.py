"""Tests of the storage of the keyframes' images and disparities."""

import pickle
import threading

import numpy as np
import pytest
import seafloor_scene as scene

from twin.core import geometry
from twin.core.records import Frame, Readings
from twin.core.settings import EstimatorSettings
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.vision import image_spool, matching
from twin.estimate.vision.stereo import Keyframe


def test_a_pair_larger_than_the_cache_is_still_returned(tmp_path, monkeypatch):
    monkeypatch.setattr(image_spool, "_CACHE_BYTES", 1000)
    spool = image_spool.ImageSpool(tmp_path)
    images = np.random.default_rng(0).integers(0, 256, (4, 24, 32, 3), np.uint8)
    levels = [matching.gray(image) for image in images]
    for row in (0, 1):
        spool.put(row, images[2 * row], images[2 * row + 1], (levels[2 * row], levels[2 * row + 1]))
    for row in (0, 1):
        for got, image, expected in zip(spool.gray(row), spool.pair(row), levels[2 * row : 2 * row + 2], strict=True):
            np.testing.assert_allclose(got, expected, atol=0.0625)  # half precision below 256
            np.testing.assert_allclose(matching.gray(image), expected)
    spool.free_cache()
    assert not spool._gray
    np.testing.assert_allclose(spool.gray(1)[0], levels[2], atol=0.0625)  # is read again
    spool.close()


@pytest.mark.parametrize("contents", [b"", b"\x89PNG\r\n", b"no image"])
def test_a_damaged_image_is_an_error_that_names_its_file(tmp_path, contents):
    spool = image_spool.ImageSpool(tmp_path)
    image = np.zeros((24, 32, 3), np.uint8)
    spool.put(3, image, image, (matching.gray(image), matching.gray(image)))
    spool.flush()
    (tmp_path / "000003_right.png").write_bytes(contents)
    assert spool.left(3).shape == image.shape
    with pytest.raises(OSError, match="000003_right.png is damaged"):
        spool.pair(3)
    spool.close()


def test_threads_that_read_an_image_wait_until_it_is_written(tmp_path, monkeypatch):
    may_write, image = threading.Event(), np.zeros((24, 32, 3), np.uint8)
    write = image_spool.ImageSpool._write
    monkeypatch.setattr(image_spool.ImageSpool, "_write", lambda *given: may_write.wait() and write(*given))
    spool, found = image_spool.ImageSpool(tmp_path), []
    spool.put(3, image, image, (matching.gray(image), matching.gray(image)))
    readers = [threading.Thread(target=lambda: found.append(spool.left(3).shape)) for _ in range(3)]
    for reader in readers:
        reader.start()
        reader.join(0.1)
    may_write.set()
    for reader in readers:
        reader.join()
    assert found == [image.shape] * 3
    spool.close()


def test_the_mosaic_is_rebuilt_from_disparities_on_disk_and_none_are_kept_in_memory(tmp_path):
    rig, floor, rng = scene.small_rig(), scene.plane(0.05, -0.03, seed=2), np.random.default_rng(3)
    pose, step = scene.down_camera(0.3, -0.2, 2.0), geometry.exp(np.array([0, 0, 0, 0.6, 0, 0.0]))
    keyframes, state_bytes = [], []
    with StereoVision(rig, EstimatorSettings(), tmp_path, cell_m=0.01) as vision:
        for row in range(3):
            colour = [np.repeat(image[..., None], 3, axis=2) for image in scene.stereo_pair(floor, rig, pose, rng)[:2]]
            frame = Frame(row, row / 30, *colour)
            vision.track_frame(frame)
            points = vision.observe_stereo(frame, row)
            vision.add_to_mosaic(row, pose)
            keyframes.append(Keyframe(row, row, 1, pose, points, Readings()))
            state_bytes.append(len(pickle.dumps(vision)))
            pose = pose @ step
        window = -300, -300, 600, 600
        added = vision.mosaic.cells.read(*window)
        vision.rebuild_mosaic(keyframes[:1])
        first = vision.mosaic.cells.read(*window)
        vision.rebuild_mosaic(keyframes)
        rebuilt = vision.mosaic.cells.read(*window)
    assert state_bytes[2] - state_bytes[1] < rig.width_px * rig.height_px / 2  # half a byte a pixel
    shown = np.isfinite(added[1])
    assert 0 < np.isfinite(first[1]).sum() < 0.9 * shown.sum()
    assert np.mean(np.isfinite(rebuilt[1]) == shown) > 0.999
    both = np.isfinite(rebuilt[1]) & shown
    assert np.quantile(np.abs(rebuilt[1][both] - added[1][both]), 0.999) < 2e-3
    assert np.mean(rebuilt[2][both] == added[2][both]) > 0.999
