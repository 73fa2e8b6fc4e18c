"""Compiles the kernels of a survey ahead, in two processes: `python -m twin.warm_up`.

numba compiles a kernel for the types of its arguments, which only its callers know. So one process flies a small
survey, and the other gives images of a flat floor to the estimators, which the survey needs later. Both keep the
compiled code on disk and load what the other has compiled before.
"""

import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import TYPE_CHECKING

from twin.errors import TwinError
from twin.kernels import cache_root, source_hash

if TYPE_CHECKING:
    from twin.core.records import ElevationMap, Frame, StereoRig

_MODULE = "twin.warm_up"
_SCENE = "quickstart"
_SMALL = ("plan.area_m=[0.8,0.8]", "plan.tracks=1", "control.hold_s=0.5")
_SHIFT_PX = 12  # of the images from frame to frame


def survey(folder: Path) -> None:
    from twin.scenario.file import load_scenario
    from twin.survey import run

    run(load_scenario(_SCENE, _SMALL), folder / "run", outputs=())


def estimators(folder: Path) -> "ElevationMap | None":
    """Returns the map of a flat floor from images, with the calibration, noise and settings of the survey."""
    from twin.estimate.pipeline import Navigator
    from twin.estimate.stereo_vision import StereoVision
    from twin.scenario.file import load_scenario

    scenario = load_scenario(_SCENE, _SMALL)
    rig, settings, depth_m = scenario.believed_rig(), scenario.estimator_settings(), scenario.plan.altitude_m
    with (
        StereoVision(rig, settings, folder / "keyframes", depth_m / rig.focal_px) as vision,
        Navigator(rig, settings, readings_noise=scenario.believed_noise(), vision=vision) as navigator,
    ):
        for frame in _frames(rig, depth_m):
            navigator.update(frame)
        return navigator.build_map(navigator.finish())


def _frames(rig: "StereoRig", depth_m: float) -> "Iterator[Frame]":
    import cv2
    import numpy as np

    from twin.core.records import Frame, Readings

    width, height, speed_mps = rig.width_px, rig.height_px, _SHIFT_PX * depth_m / rig.focal_px * rig.frame_rate_hz
    floor = cv2.GaussianBlur(np.random.default_rng(1).normal(128, 200, (height, 4 * width, 3)), (0, 0), 2.0)
    floor, disparity = np.clip(floor, 0, 255).astype(np.uint8), round(rig.focal_px * rig.baseline_m / depth_m)
    readings = Readings(depth_m, np.zeros(3), np.array([0.0, -speed_mps, 0.0]))
    for k in range(2 * width // _SHIFT_PX):
        left, right = (
            np.ascontiguousarray(floor[:, x:][:, :width]) for x in (k * _SHIFT_PX, k * _SHIFT_PX + disparity)
        )
        yield Frame(k, k / rig.frame_rate_hz, left, right, readings, k % 10 == 0, (1.0, 1.0, 1.0))


TASKS: dict[str, Callable[[Path], object]] = {"survey": survey, "estimators": estimators}


def main() -> int:
    """Compiles the kernels, unless this was done for the present sources, and shows the progress; returns 0 or 1."""
    stamp, sources = cache_root() / "compiled", source_hash(Path(__file__))
    if stamp.is_file() and stamp.read_text() == sources:
        return 0
    begin = time.time()
    command = [sys.executable, "-P", "-m", _MODULE]
    workers = [subprocess.Popen([*command, task], stdout=subprocess.DEVNULL) for task in TASKS]
    while any(worker.poll() is None for worker in workers):
        time.sleep(0.5)
        if sys.stderr.isatty():
            print(f"\rCompiling kernels, once: {_progress(begin)}", end="", file=sys.stderr, flush=True)
    print(f"\rCompiled kernels: {_progress(begin)}          ", file=sys.stderr)
    if any(worker.returncode for worker in workers):
        return 1
    stamp.write_text(sources)
    return 0


def _progress(begin: float) -> str:
    n_compiled = sum(file.stat().st_mtime >= begin for file in cache_root().rglob("*.nbc"))
    return f"{n_compiled} functions, {time.time() - begin:.0f} s"


if __name__ == "__main__":
    if sys.argv[1:]:
        with TemporaryDirectory(prefix="twin-") as temporary:
            try:
                TASKS[sys.argv[1]](Path(temporary))
            except TwinError as error:
                sys.exit(str(error))
    else:
        sys.exit(main())
