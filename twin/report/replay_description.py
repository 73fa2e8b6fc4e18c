"""Description of a replayed run in its run folder (scenario.resolved.toml): data set, settings and rectified rig."""

from collections.abc import Mapping
from dataclasses import asdict
from typing import Any, NamedTuple

import numpy as np
import tomlkit

from twin.core.records import StereoRig
from twin.core.settings import EstimatorSettings
from twin.errors import TwinError

_RIG_KEYS = ("image_width_px", "image_height_px", "focal_px", "baseline_m", "frame_rate_hz", "focal_y_px")


class RunDescription(NamedTuple):
    name: str  # name of the run
    seed: int | None  # seed of its random numbers; None if it has none
    text: str  # contents of scenario.resolved.toml


def describe_replay(
    name: str, source: Mapping[str, Any], rig: StereoRig, settings: EstimatorSettings, estimator: str | None = None
) -> RunDescription:
    """Returns the description of a replayed run: `source` (texts and numbers), rectified rig, and estimators."""
    tree = {
        "name": name,
        "replay": dict(source),
        "rig": {
            "image_width_px": rig.width_px,
            "image_height_px": rig.height_px,
            "hfov_deg": float(np.rad2deg(2 * np.arctan(rig.width_px / 2 / rig.focal_px))),
            "baseline_m": rig.baseline_m,
            "frame_rate_hz": rig.frame_rate_hz,
            "focal_px": rig.focal_px,
            "focal_y_px": rig.fy_px,
            "principal_point_px": [rig.cx_px, rig.cy_px],
        },
        "estimate": asdict(settings) | ({} if estimator is None else {"plugin": estimator}),
    }
    return RunDescription(name, None, tomlkit.dumps(tree))


def replayed_rig(scenario: Mapping[str, Any]) -> StereoRig | None:
    """Returns the rig in scenario.resolved.toml; None for a run of a scenario; raises TwinError for a wrong value."""
    if "replay" not in scenario:
        return None
    try:
        rig = scenario["rig"]
        width, height, focal_px, baseline_m, rate_hz, focal_y_px = (float(rig[key]) for key in _RIG_KEYS)
        cx, cy = (float(value) for value in rig["principal_point_px"])
    except (KeyError, TypeError, ValueError):
        raise TwinError(
            "scenario.resolved.toml: rig", "is not the rig of a replay", "a file of `twin replay`"
        ) from None
    return StereoRig(
        int(width), int(height), focal_px, baseline_m, rate_hz, focal_y_px=focal_y_px, principal_point_px=(cx, cy)
    )
