"""Latency of the computer on the vehicle: time from an image to the command that follows from it."""

import math

from twin.controllers.survey_plan import SurveyPlan
from twin.errors import TwinError
from twin.scenario.model import Scenario

#: Times of the estimators on the reference computer (2 cores of an x86-64 machine) at 320 x 240 pixels, from the
#: processing budget in docs/paper.md: of F2F, and of the further work on a keyframe (F2M, stereo, flow, motions).
_FRAME_S, _KEYFRAME_S, _PIXELS = 0.0017, 0.0823, 320 * 240


def latency_s(scenario: Scenario) -> float:
    """Returns the stated latency [s] or, for "stated", the longest time of the estimators (by pixels), a constant."""
    latency = scenario.control.latency
    if latency == "stated":
        return math.fsum(_times_s(scenario))
    return 0.0 if latency == "none" else latency


def frames_of_latency(scenario: Scenario) -> int:
    """Returns the latency in whole frames; that of the estimators is rounded up."""
    n = latency_s(scenario) * scenario.rig.frame_rate_hz
    return math.ceil(n) if scenario.control.latency == "stated" else round(n)


def check_computer(scenario: Scenario, plan: SurveyPlan) -> None:
    """Raises TwinError if a computer of stated speed cannot process the frames as fast as they come."""
    if scenario.control.latency != "stated":
        return
    (frame_s, keyframe_s), n = _times_s(scenario), plan.n_frames_per_keyframe
    needed = (n * frame_s + keyframe_s) * scenario.rig.frame_rate_hz / n
    if needed > 1:
        speed = scenario.control.computer_speed
        problem = f"{speed:g}: the estimators take {100 * needed:.0f} % of the time between the frames"
        raise TwinError("control.computer_speed", problem, f"at least {math.ceil(1000 * speed * needed) / 1000:g}")


def _times_s(scenario: Scenario) -> tuple[float, float]:
    """Returns the times of a frame, and of the further work on a keyframe [s]."""
    scale = scenario.rig.image_width_px * scenario.rig.image_height_px / _PIXELS / scenario.control.computer_speed
    return scale * _FRAME_S, scale * _KEYFRAME_S
