"""What images answer, beside the truth: the raw material of a calibration.

A witness passes every question on to the images, puts the same question to the surrogate at the same true poses, and
writes down by how much the claims of the two differ and how far each is from the truth. Both see the same geometry, so
the ratios are those of the error models alone.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Sequence

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import ElevationMap, Frame, MapGrid, SurveyResult
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.vision.keyframes import Keyframe
from twin.estimate.vision.mosaic import Registration
from twin.estimate.vision.stereo import StereoPoints
from twin.estimate.vision.two_view_motion import Motion
from twin.surrogate.error_model import Law
from twin.surrogate.vision import SurrogateVision

_LEAST_CELLS = 300
_EXACT = Law(1e-4, 0.0)
STEADY, RELIEF = 0.8, 0.2  # of the links that have one error alone


class Witness:
    """Vision by images, with a record of it.

    Args:
        images: what answers.
        surrogate: what is compared.
        truth: gives the true pose (4, 4) of the left camera now.
    """

    def __init__(self, images: StereoVision, surrogate: SurrogateVision, truth: Callable[[], Array]):
        self.images, self.surrogate, self._truth = images, surrogate, truth
        self.stereo_observations = images.stereo_observations
        self.notes: dict[str, list[float]] = defaultdict(list)
        self.notes["lamp_share"] = [surrogate.lamp_share]
        self._poses: dict[int, Array] = {}
        self._node = -1  # the last one
        self._chain: tuple[int, dict[str, Array]] = (-1, {})  # where the last link of the path ended, and its errors
        self._last: Array | None = None
        self._walked: list[tuple[Array, Array]] = []  # error and claimed covariance of the frames since a keyframe

    def track_frame(self, frame: Frame) -> tuple[Motion, str]:
        (seen, status), (guessed, _) = self.images.track_frame(frame), self.surrogate.track_frame(frame)
        last, self._last = self._last, self._truth()
        if last is not None and status == "ok" and seen.n_points:
            true = geometry.inverse(last) @ self._last
            self.notes["f2f_claim"].append(_ratio(seen.cov, guessed.cov))
            errors = [geometry.log(geometry.inverse(true) @ motion.a_from_b) for motion in (seen, guessed)]
            self.notes["f2f_nees"].append(_chi2(errors[0], seen.cov) / 6)
            self.notes["f2f_nees_surrogate"].append(_chi2(errors[1], guessed.cov) / 6)
            self._walked.append((errors[0], seen.cov))
        return seen, status

    def observe_stereo(self, frame: Frame, row: int) -> StereoPoints | None:
        points, guessed = self.images.observe_stereo(frame, row), self.surrogate.observe_stereo(frame, row)
        if len(self._walked) > 1:
            error, cov = (np.sum(x, axis=0) for x in zip(*self._walked, strict=True))
            self.notes["f2f_interval"].append(_chi2(error, cov) / 6)
            self.notes["f2f_frames"].append(float(len(self._walked)))
        self._walked = []
        if points is not None and guessed is not None:
            self.notes["points"].append(len(points.xyz) / self.images.settings.points)
            sizes = [float(np.median(np.trace(x.cov, axis1=1, axis2=2))) for x in (points, guessed)]
            self.notes["place_ratio"].append(float(np.sqrt(sizes[0] / sizes[1] * self.surrogate.stand_for)))
            self.notes["bound_px"].append(self.surrogate.bound_px)
        return points

    def restart_tracking(self) -> None:
        self.images.restart_tracking()
        self.surrogate.restart_tracking()

    def register_with_mosaic(self, world_from_camera: Array) -> Registration | None:
        found, drawn = (
            self.images.register_with_mosaic(world_from_camera),
            self.surrogate.register_with_mosaic(world_from_camera),
        )
        if found is not None and drawn is not None:
            seen, guessed = found.correction, drawn.correction
            self.notes["mosaic_claim"].append(_ratio(seen.cov, guessed.cov))
            off = geometry.log(geometry.inverse(guessed.a_from_b) @ seen.a_from_b)
            self.notes["mosaic_difference"].append(_chi2(off, guessed.cov) / 6)
        return found

    def add_to_mosaic(self, number: int, world_from_camera: Array) -> None:
        self._poses[number] = self._truth()
        self.images.add_to_mosaic(number, world_from_camera)
        self.surrogate.add_to_mosaic(number, world_from_camera)

    def rebuild_mosaic(self, keys: Sequence[Keyframe]) -> None:
        self.images.rebuild_mosaic(keys)
        self.surrogate.rebuild_mosaic(keys)

    def discard(self, numbers: range) -> None:
        self.images.discard(numbers)
        self.surrogate.discard(numbers)

    def measure_motions(self, node: Keyframe, others: Sequence[Keyframe]) -> list[Motion | None]:
        """The links of the images; those of the surrogate with all errors; and with one error alone."""
        model, answers = self.surrogate.model, {"images": self.images.measure_motions(node, others)}
        alone = {
            "all": model,
            "patches": model._replace(place_excess=1.0, lamps=0.0, steady=STEADY, relief=0.0),
            "relief": model._replace(place_excess=0.0, relief=RELIEF, common_px=0.0),
        }
        answers |= {name: self.surrogate.links(node, others, errors) for name, errors in alone.items()}
        pose = self._poses.get(node.number)
        here = self._truth() if pose is None else pose
        for k, other in enumerate(others):
            links = {name: motions[k] for name, motions in answers.items()}
            self._note_link(other.number, node.number, links, geometry.inverse(self._poses[other.number]) @ here)
        self._node = node.number
        return answers["images"]

    def _note_link(self, i: int, j: int, links: dict[str, Motion | None], true: Array) -> None:
        """Notes by how much the links from i to j err, in the surrogate's claims.

        Of two links along the path, by how much one undoes what the one before it erred by.
        """
        seen, guessed = links["images"], links["all"]
        if seen is None or guessed is None:
            return
        self.notes["link_claim"].append(_ratio(seen.cov, guessed.cov))
        self.notes["link_matched"].append(seen.n_points / guessed.n_points)
        self.notes["link_apart"].append(self.surrogate.way_in_depths(true))
        errors = {name: geometry.log(geometry.inverse(true) @ m.a_from_b) for name, m in links.items() if m is not None}
        for name, error in errors.items():
            self.notes[f"link_{name}"].append(_chi2(error, guessed.cov) / 6)
        if i == self._node:
            (end, before), self._chain = self._chain, (j, errors)
            sigma, carry = np.sqrt(np.diag(guessed.cov)), geometry.adjoint(geometry.inverse(true))
            for name, last in before.items() if end == i else ():
                self.notes[f"chain_{name}"].append(float(carry @ last / sigma @ (errors[name] / sigma)) / 6)

    def build_map(
        self, result: SurveyResult, grid: MapGrid, step_cov: Array, progress: Callable[[int], None]
    ) -> ElevationMap:
        """The map of the images; and those of the surrogate along the same path, each with one error alone."""
        mapped, model = self.images.build_map(result, grid, step_cov, progress), self.surrogate.model
        alone = {
            "pose": model._replace(depth_px=_EXACT, lateral_px=0.0),
            "depth": model._replace(lateral_px=0.0),
            "lateral": model._replace(depth_px=_EXACT),
        }
        chart = self.surrogate.chart
        self.notes["map_known"].append(float(np.isfinite(mapped.height_m[chart.seen]).mean()))
        for name, errors in alone.items():
            self.surrogate.model = errors
            self._note_map(name, self.surrogate.build_map(result, grid, step_cov, lambda _: None))
        self.surrogate.model = model
        self._note_map("images", mapped)
        return mapped

    def _note_map(self, whose: str, mapped: ElevationMap) -> None:
        """Squares of the robust deviation, and of the claimed one, of level and of steep cells [m^2]."""
        chart = self.surrogate.chart
        error = mapped.height_m - chart.height_m
        for name, where in (("level", chart.steepness < 0.3), ("steep", chart.steepness > 0.6)):
            known = where & chart.seen & np.isfinite(error)
            if known.sum() > _LEAST_CELLS:
                off = error[known] - np.median(error[known])
                self.notes[f"map_{name}_{whose}"].append(float((1.4826 * np.median(np.abs(off))) ** 2))
                self.notes[f"map_{name}_{whose}_claimed"].append(float(np.median(mapped.sigma_m[known]) ** 2))


def _chi2(error: Array, cov: Array) -> float:
    return float(error @ np.linalg.solve(cov, error))


def _ratio(cov: Array, other: Array) -> float:
    """By how much one covariance is wider than another: the mean ratio of their deviations in all directions."""
    return float(np.exp((np.linalg.slogdet(cov)[1] - np.linalg.slogdet(other)[1]) / (2 * len(cov))))
