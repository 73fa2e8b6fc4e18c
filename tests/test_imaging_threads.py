"""Row bands: results do not depend on the number of threads."""

import types

import numpy as np
import pytest

from twin.core import geometry, threads
from twin.imaging.image_formation import ImageFormation, RenderedView, StampedPose
from twin.imaging.light.illumination import illumination_of
from twin.scenario.model import Scenario

SCENARIO = Scenario.model_validate(
    {
        "rig": {"image_width_px": 160, "image_height_px": 120},
        "lamps": [{"position_m": (0.25, y, -0.05), "pan_deg": -15 * np.sign(y)} for y in (0.6, -0.6)],
        "water": {"jerlov": "II"},
        "imaging": {"shadows": True},
    }
)
SPIKES = types.SimpleNamespace(
    height_m=np.random.default_rng(0).uniform(0, 0.3, (81, 81)).astype(np.float32),
    spacing_m=0.1,
    west_m=-4.0,
    south_m=-4.0,
)


@pytest.mark.parametrize(("n_rows", "rows_per_row", "n_bands"), [
    (63, 1, 1), (64, 1, 2), (8, 8, 2), (7, 8, 1), (240, threads.QUICK, 1), (480, threads.QUICK, 2),
])  # fmt: skip
def test_an_image_is_split_where_it_has_enough_rows(monkeypatch, n_rows, rows_per_row, n_bands):
    monkeypatch.setattr(threads, "_n_processors", lambda: threads.THREADS)
    bands = []
    threads.in_row_bands(lambda *band: bands.append(band), n_rows, rows_per_row)
    assert len(bands) == n_bands


@pytest.mark.parametrize("n_rows", [1, 63, 64, 65, 481])
def test_every_row_is_processed_once(monkeypatch, n_rows):
    monkeypatch.setattr(threads, "_n_processors", lambda: threads.THREADS)
    count = np.zeros(n_rows, int)

    def work(first, end):
        count[first:end] += 1

    threads.in_row_bands(work, n_rows)
    assert (count == 1).all()


def test_radiance_is_the_same_with_one_and_two_threads(monkeypatch):
    """To the last bit, with shadows and multiple scattering, over a random floor."""
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.0, 0.0, 2.0]))
    albedo = np.random.default_rng(1).integers(0, 256, (120, 160, 3), dtype=np.uint8)
    depth = np.random.default_rng(2).uniform(1.7, 2.0, (120, 160)).astype(np.float32)
    images = []
    for processors in (1, 2):
        monkeypatch.setattr(threads, "_n_processors", lambda n=processors: n)
        light = ImageFormation(SCENARIO, illumination_of(SCENARIO), SPIKES, np.random.default_rng(0))
        images += [light.radiance(RenderedView(albedo, depth, camera, StampedPose(pose, 0.0))) for camera in (0, 1)]
    np.testing.assert_array_equal(images[0], images[2])
    np.testing.assert_array_equal(images[1], images[3])


@pytest.mark.parametrize("bad_row", [0, 499])
def test_an_exception_in_any_band_is_raised(monkeypatch, bad_row):
    monkeypatch.setattr(threads, "_n_processors", lambda: threads.THREADS)

    def work(first, end):
        if first <= bad_row < end:
            raise ValueError(bad_row)

    with pytest.raises(ValueError, match=str(bad_row)):
        threads.in_row_bands(work, 500)


@pytest.mark.parametrize("processors", [1, 2])
def test_a_pair_is_computed_without_splitting_images(monkeypatch, processors):
    """Each image in one band, and images are split again afterwards."""
    monkeypatch.setattr(threads, "_n_processors", lambda: processors)
    bands = {"left": [], "right": [], "after": []}

    def image(name):
        threads.in_row_bands(lambda *band: bands[name].append(band), 500)
        return name

    assert threads.in_pair(lambda: image("left"), lambda: image("right")) == ("left", "right")
    image("after")
    assert bands["left"] == bands["right"] == [(0, 500)]
    assert len(bands["after"]) == processors


@pytest.mark.parametrize("fails", ["left", "right"])
def test_an_exception_in_an_image_of_a_pair_is_raised(monkeypatch, fails):
    """The other image is completed first, and images are split again afterwards."""
    monkeypatch.setattr(threads, "_n_processors", lambda: threads.THREADS)
    completed = []

    def image(name):
        if name == fails:
            raise ValueError(name)
        completed.append(name)

    with pytest.raises(ValueError, match=fails):
        threads.in_pair(lambda: image("left"), lambda: image("right"))
    assert len(completed) == 1
    bands = []
    threads.in_row_bands(lambda *band: bands.append(band), 500)
    assert len(bands) == threads.THREADS
