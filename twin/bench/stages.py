"""Stages of a rendered survey, each with its floor on the same images."""

import time
from collections.abc import Callable
from functools import partial
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import cv2
import numpy as np

from twin.bench.measurement import N_ROUNDS, BenchmarkRow, processor_ms
from twin.bench.plain_renderer import PlainRenderer
from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Frame, Image, SurveyResult
from twin.core.timing import Stopwatch
from twin.estimate.vision import f2f, matching
from twin.estimate.vision.disparity import BLOCK_PX
from twin.scenario.file import load_scenario
from twin.session.assembly import image_vision, navigator_with, open_world
from twin.survey import fly
from twin.world.mission import Mission, prepare

SMALL = ("plan.tracks=1", "plan.area_m=[0.8,0.8]", "control.hold_s=0.5")  #: a survey of 11 s
_PLAIN = "mujoco.Renderer, same views"
_SGBM, _FLOW = "cv2.StereoSGBM, three-way", "cv2.calcOpticalFlowPyrLK, as many points"
#: Unit and floor of each stage of the stopwatch.
_STAGES = {
    "render": ("ms an image", "mujoco.Renderer"), "optics": ("ns a pixel", "numpy: exp(-c r) in three bands"),
    "f2f": ("ms a frame", _FLOW), "stereo": ("ms a keyframe", _SGBM), "flow": ("ms a link", _FLOW),
    "network": ("ms a link", "cv2.solvePnP, as many points"), "map": ("ms a keyframe", _SGBM),
}  # fmt: skip
_Flown = list[tuple[Frame, Array, Array]]  # with pose of the left camera and twist of the body


def stage_rows(progress: Callable[[float], None]) -> list[BenchmarkRow]:
    """Returns the rows of all stages and of their sums; a round renders the images of one flight, and estimates."""
    watch, mission, flown = Stopwatch(time.process_time), prepare(load_scenario("reef", SMALL)), _Flown()
    rounds: dict[str, list[Array]] = {stage: [] for stage in _STAGES}
    sums = list[list[float]]()  # of all stages, of their floors, and of plain rendering
    with PlainRenderer(mission.terrain, mission.rig) as plain, open_world(mission, watch) as world:
        camera: Any = world.camera  # pyright: ignore[reportAttributeAccessIssue] (of a rendered world)

        def observe(_: Any, frame: Frame) -> None:
            flown.append((frame, world.world_from_camera, world.vehicle.twist_body))

        _estimate(mission, watch, lambda navigator: fly(mission, world, navigator, observe))  # loads compiled code
        for k in range(N_ROUNDS):
            done = {stage: len(watch.durations_ms(stage)) for stage in _STAGES}
            for frame, pose, twist_body in flown:
                camera.capture(pose, frame.right is not None, twist_body)
            result = _estimate(mission, watch, lambda navigator: [navigator.update(frame) for frame, *_ in flown])
            works_of, ms = _floors(mission, flown, result, plain), dict[str, tuple[float, float]]()
            for stage, works in works_of.items():
                ms[stage] = sum(watch.durations_ms(stage)[done[stage] :]), sum(map(processor_ms, works))
                rounds[stage].append(np.array(ms[stage]) / len(works))
            sums.append([*map(sum, zip(*ms.values(), strict=True)), ms["render"][1]])
            progress((k + 1) / N_ROUNDS)
    scales = {"ns a pixel": 1e6 / (mission.rig.width_px * mission.rig.height_px)}
    rows = []
    for stage, (unit, floor) in _STAGES.items():
        values, floors = scales.get(unit, 1.0) * np.array(rounds[stage]).T
        rows.append(BenchmarkRow(stage, unit, values, floor, floors))
    whole = zip(("all stages", "floors of all stages"), np.array(sums).T, strict=False)
    return [*rows, *(BenchmarkRow(name, "ms a survey", ms, _PLAIN, np.array(sums).T[2]) for name, ms in whole)]


def _estimate(mission: Mission, watch: Stopwatch, run: Callable[[Any], object]) -> SurveyResult:
    """Returns the result of the estimators, which `run` gives the frames; builds the map, too."""
    with TemporaryDirectory(prefix="twin-") as folder, image_vision(mission, Path(folder), watch) as vision:
        vision.runs_in_background = False  # the processor time of a stage would include that of others
        with navigator_with(mission, vision, watch) as navigator:
            run(navigator)
            result = navigator.finish()
            with watch("map"):
                navigator.build_map(result, mission.grid)
    return result


def _floors(
    mission: Mission, flown: _Flown, result: SurveyResult, plain: PlainRenderer
) -> dict[str, list[Callable[[], object]]]:
    """Returns the floors of all stages, each one per unit."""
    rig, settings, rows = mission.rig, mission.scenario.estimator_settings(), result.keyframe_rows.tolist()
    poses, depth_m = [pose for _, pose, _ in flown], float(np.median(result.keyframe_depth_m))
    attenuation_per_m = np.array([0.4, 0.1, 0.2], np.float32)
    range_m = np.full((rig.height_px, rig.width_px, 1), depth_m, np.float32)
    left = [_normalised(frame.left) for frame, *_ in flown]
    keyframes = [(left[row], _normalised(flown[row][0].right)) for row in rows]
    points = [matching.corners(image, settings.points, settings.patch_px) for image, _ in keyframes]
    search_px, window = 2 * int(rig.focal_px * rig.baseline_m / depth_m), (settings.patch_px,) * 2
    links, noise = result.links, np.random.default_rng(1)

    def track(source: Image, target: Image, pixels: Any) -> Callable[[], object]:
        return partial(cv2.calcOpticalFlowPyrLK, source, target, pixels, None, winSize=window)  # pyright: ignore

    def motion(j: int, i_from_j: Array) -> Callable[[], object]:
        xyz = depth_m * np.column_stack([rig.normalised(points[j]), np.ones(len(points[j]))])
        seen = rig.project(geometry.transform(i_from_j, xyz)) + noise.normal(0, 0.1, (len(xyz), 2))
        return partial(cv2.solvePnP, xyz, rig.normalised(seen), np.eye(3), None)

    return {
        "render": [partial(plain.render, p) for p in (*poses, *(poses[row] @ rig.left_from_right for row in rows))],
        "optics": [lambda: np.exp(-attenuation_per_m * range_m)] * (len(poses) + len(rows)),
        "f2f": [track(*images, points[0][: f2f.MAX_POINTS]) for images in pairwise(left)],
        "stereo": [partial(_match, *images, search_px) for images in keyframes],
        "flow": [track(left[rows[j]], left[rows[i]], points[j]) for i, j in zip(links.i, links.j, strict=True)],
        "network": [motion(j, i_from_j) for j, i_from_j in zip(links.j, links.i_from_j, strict=True)],
        "map": [partial(_match, *images, search_px) for images in keyframes],
    }


def _normalised(rgb: Image | None) -> Image:
    assert rgb is not None
    return matching.normalise(matching.gray(rgb))


def _match(left: Image, right: Image, search_px: int) -> None:
    options = {"P1": 8 * BLOCK_PX**2, "P2": 32 * BLOCK_PX**2, "mode": cv2.StereoSGBM_MODE_SGBM_3WAY}
    cv2.StereoSGBM.create(0, -(-search_px // 16) * 16, BLOCK_PX, **options).compute(left, right)
