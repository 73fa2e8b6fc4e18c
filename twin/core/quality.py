"""Records on the quality of a survey: consistency of the estimates, findings, and durations of actions."""

from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array


class EpipolarError(NamedTuple):
    #: (4,) pitch, yaw, roll [rad], with the signs of `calibration_error.right_*`, and row offset [focal lengths].
    estimate: Array
    sigma: Array  #: (4,) standard deviations of `estimate`
    removed: Array  #: (4,) errors corrected in the right images, in the same units; the yaw is that of self-calibration
    #: weighted RMS over the regions of the image of the mean row difference that `estimate` does not explain, without
    #: the part due to matching noise [focal lengths].
    pattern: float = 0.0


class DisparityOffset(NamedTuple):
    """Offset that all disparities share, estimated from the motions between keyframes [focal lengths]."""

    estimate: float  #: measured minus true disparity
    sigma: float  #: standard deviation of `estimate`


class DistortionError(NamedTuple):
    """Radial distortion of both cameras that is not corrected, estimated from the motions between keyframes."""

    estimate: float  #: k1, true minus believed
    sigma: float  #: standard deviation of `estimate`


class YawEffect(NamedTuple):
    """Yaw of the right camera away from the left one, estimated from a motion between keyframes, and its effect."""

    estimate: float  #: rotation since the calibration [rad]
    sigma: float  #: standard deviation of `estimate`
    by_yaw: Array  #: (6,) change of the measured motion per rotation (rad, m per rad), in the axes of the later camera
    removed_rad: float = 0.0  #: rotation for which the images were corrected before the motion was measured


class CalibrationEstimate(NamedTuple):
    """Errors of the calibration that the last global alignment estimated together with the poses (true minus believed).

    They are 0 and exact where the calibration is taken as exact.
    """

    yaw_rad: float = 0.0  #: rotation of the right camera away from the left one
    baseline_error: float = 0.0  #: relative error of the baseline
    cov: Array = np.zeros((2, 2))  #: covariance of both


EXACT = CalibrationEstimate()


class LengthScale(NamedTuple):
    """Lengths from the images divided by those of navigation sensors; 1 is expected."""

    #: estimate, sigma: the ratio and its standard deviation.
    estimate: float
    sigma: float
    sensors: str  #: names of the sensors that determine it


class EstimationQuality(NamedTuple):
    """Consistency of the estimates of a survey, measured by the estimators without the truth."""

    frames_lost: int = 0  #: number of frames whose motion could not be measured and was predicted
    nodes_bridged: int = 0  #: number of nodes linked to the previous node only by predicted or frame-to-frame motion
    #: links_tried, links_failed: number of attempted and of failed measurements of links between nodes.
    links_tried: int = 0
    links_failed: int = 0
    #: median over the links of the residual of the points / its expected value; None without a measured link.
    link_residual: float | None = None
    #: mean chi-square of the links after the last alignment, per degree of freedom (1 expected); None without one.
    link_chi2: float | None = None
    alignment_converged: bool = True  #: whether the last global alignment converged; True without an alignment
    #: estimated errors of the rectification; None without images, unless a surrogate models them.
    epipolar: EpipolarError | None = None
    #: standard deviation (3-D) of the position of a keyframe relative to the previous keyframe, by frame-to-frame
    #: motion alone; 90th percentile over the keyframes [m]; None if it is not known at any keyframe.
    frame_sigma_m: float | None = None
    #: offset common to all disparities, from the links; None without images or if it is not observable.
    disparity_offset: DisparityOffset | None = None
    distortion: DistortionError | None = None  #: error of k1, from the links; None without images
    calibration: CalibrationEstimate = EXACT  #: errors of the calibration found by self-calibration
    #: number of independent errors equivalent to the position errors of all keyframes; None without a final alignment.
    independent_errors: float | None = None
    #: length_scale, depth_scale: scale of image lengths across and along the optical axis; None without a sensor.
    length_scale: LengthScale | None = None
    depth_scale: LengthScale | None = None
    #: rows of the frames at which a camera was frozen, by status ("the left camera repeats its image").
    repeats: Mapping[str, Sequence[int]] = MappingProxyType({})
    #: number of readings of each navigation sensor that were not used, because they contradicted the estimates.
    readings_rejected: Mapping[str, int] = MappingProxyType({})
    #: numbers of readings of each navigation sensor that contradicted the estimates as many before them, and of those
    #: that were believed because motions had been predicted since the sensor last agreed; the others were not used.
    readings_disputed: Mapping[str, int] = MappingProxyType({})
    readings_believed: Mapping[str, int] = MappingProxyType({})
    altimeter_m: Mapping[int, float] = MappingProxyType({})  #: readings of the altimeter at keyframes, by frame [m]
    #: RMS of the residuals that successive readings of a sensor share / standard deviation of a reading, by sensor.
    lasting_residuals: Mapping[str, float] = MappingProxyType({})
    reading_notes: Sequence[str] = ()  #: sentences on sensors that were frozen, or gave no readings for long

    @property
    def repeat_notes(self) -> list[str]:
        return [
            f"{status.capitalize()} in {len(rows)} frames ({_spans(rows)}); these images were not used."
            for status, rows in self.repeats.items()
        ]


def _spans(rows: Sequence[int], most: int = 5) -> str:
    spans = np.split(np.array(rows), np.flatnonzero(np.diff(rows) > 1) + 1)
    texts = [str(s[0]) if len(s) == 1 else f"{s[0]} to {s[-1]}" for s in spans[:most]]
    return ", ".join(texts + ["..."] * (len(spans) > most))


class Finding(NamedTuple):
    """A failed check of the estimates: a reason why the result of a survey must not be trusted."""

    check: str  #: short name of the check, as in log.jsonl
    value: float  #: measured value
    limit: float  #: largest (or smallest) value that passes the check
    sentence: str  #: the finding in words
    #: standard deviation of the relative error that all lengths may have because of it; 0: not determined.
    length_error: float = 0.0


class Energy(NamedTuple):
    """Energy of thrusters and hotel load; None for a kinematic vehicle."""

    survey_wh: float | None = None  #: energy of the survey [W h]
    dives: int | None = None  #: number of batteries that it takes, each with a reserve of a fifth


class Gaps(NamedTuple):
    """Parts of the asked area that fewer than two keyframes show; None if they were not looked for."""

    found_m2: float | None = None  #: after the planned tracks [m2]
    left_m2: float | None = None  #: after the legs over them [m2]

    @property
    def sentence(self) -> str:
        if not self.found_m2 or self.left_m2 is None:
            return ""
        left = f"{self.left_m2:.2g} m2 of them could not be covered" if self.left_m2 else "none is left"
        return f"After the planned tracks, gaps of {self.found_m2:.2g} m2 were flown over; {left}."


class ActionTimes(NamedTuple):
    """Durations of the actions "slow" and "hold" of a mission [s]."""

    slowed_s: float = 0.0
    held_s: float = 0.0

    @property
    def sentence(self) -> str:
        done = [f"slowed for {self.slowed_s:.1f} s because frames were lost"] * (self.slowed_s > 0)
        done += [f"held station for {self.held_s:.1f} s because vision was lost"] * (self.held_s > 0)
        return f"The vehicle {' and '.join(done)}." if done else ""
