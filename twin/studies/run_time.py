"""Run time of rendered surveys, expected from those flown so far, and durations read from text."""

import re
from collections.abc import Iterable

from twin.errors import TwinError
from twin.scenario.model import Scenario
from twin.studies.flight import Row

# Run time of a rendered frame on one CPU core of 2025: 0.023 s for 320 x 240 pixels, 0.07 s for 640 x 480 pixels.
_FRAME_S = 0.008  # part that does not depend on the image size [s]
_MEGAPIXEL_S = 0.2  # part per megapixel of one camera's image [s]
_UNITS_S = {"s": 1.0, "m": 60.0, "min": 60.0, "h": 3600.0, "d": 86400.0}
_DURATION = re.compile(r"(\d+(?:\.\d*)?)\s*([a-z]+)")


def rendered_time(rows: Iterable[Row], scenario: Scenario, simulated_s: float) -> tuple[float, str]:
    """Returns the expected run time of a rendered survey on one CPU core [s], and how it was found."""
    # simulated duration times that per simulated second in rendered rows, or as by frame rate and image size
    run_s = flown_s = 0.0
    for row in rows:
        if row.get("fidelity") == "rendered" and row.get("timing.simulated_s"):
            run_s, flown_s = run_s + (row.get("timing.survey_s") or 0.0), flown_s + row["timing.simulated_s"]
    if run_s and flown_s:
        return simulated_s * run_s / flown_s, "as measured"
    rig = scenario.rig
    frame_s = _FRAME_S + _MEGAPIXEL_S * 1e-6 * rig.image_width_px * rig.image_height_px
    return simulated_s * rig.frame_rate_hz * frame_s, "a rough estimate"


def parsed_duration(text: str, option: str) -> float:
    """Returns the duration [s] that a text such as "90s", "45m", "2h" or "1h30m" states; raises TwinError if none."""
    parts = _DURATION.findall(text.strip().lower())
    known = "".join(f"{number}{unit}" for number, unit in parts) == re.sub(r"\s", "", text.lower())
    total_s = sum(float(number) * _UNITS_S.get(unit, 0.0) for number, unit in parts)
    if not known or not total_s or any(unit not in _UNITS_S for _, unit in parts):
        raise TwinError(option, f"{text!r} is not a duration", "a number with s, m, h or d, e.g. 45m, 2h or 1h30m")
    return total_s
