"""The mission of Negahdaripour & Madjidi (2003, section V-A): 25 tracks over 100 ft x 100 ft, and the paper's figures.

The mission is flown three times: over the paper's coarse texture with alignment, over the same floor on the integrated
F2F motion alone, and at full resolution with alignment. All flights are by vision alone.
"""

from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np

from twin.core.records import Array
from twin.judge.map_error import height_error
from twin.judge.summary_statistics import percentile, rms
from twin.judge.trajectory_errors import PathErrors, farthest_error_m, path_errors, track_metrics
from twin.reproduce import paper_sheet
from twin.reproduce.exhibit import DASH, Exhibit, Figure, Row, Table, make_table, millimetres, percent, write_exhibit
from twin.reproduce.paper_flight import Flown, fly_aligned, fly_in_parallel, fly_without_alignment
from twin.scenario.file import load_scenario
from twin.scenario.model import Scenario

FOOT_M = 0.3048
#: Tracks whose errors the paper shows in Fig. 5.
SHOWN_TRACKS = (1, 2, 3, 4, 5, 11, 16, 21, 25)
FIRST_TRACKS, FEW = 5, 3  # the paper distinguishes the first five tracks, and "a few" others with larger errors
MEAN_RANGE_M = 8 * FOOT_M  # the paper relates its errors of elevation to this range
FINE = ("navigation.aiding=[]",)  # overrides of the scenario at full resolution
#: The quick plan: 25 tracks as far apart as the paper's, with legs of half a metre, at five frames per second and
#: without rotation, as in the paper.
QUICK = (
    "plan.area_m=[0.5, 30.48]", "terrain.size_m=[6.0, 36.0]", "rig.frame_rate_hz=5", "control.hold_s=0.4",
    "plan.overlap_along=0.8", "vehicle.dynamics=kinematic",
)  # fmt: skip


CAPTIONS = {
    "paths": "Integrated frame-to-frame motion, and the path after alignment (Fig. 4).",
    "tracks": "Position error of all keyframes so far, just before and after the global alignment at the end of a "
    "track, for the tracks of Fig. 5.",
    "errors": "Errors of position, height and heading along the path after alignment; dashed: ends of tracks (Fig. 6).",
    "maps": "True elevation, map after alignment, map flown without alignment, and histogram of the absolute error "
    "(Fig. 7).",
}


class Flights(NamedTuple):
    coarse: Flown  #: over the coarse texture
    unaligned: Flown  #: over the coarse texture, without alignment
    fine: Flown  #: at full resolution

    @property
    def aligned(self) -> tuple[Flown, Flown]:
        return self.coarse, self.fine


class Claim(NamedTuple):
    """A result that the paper states."""

    label: str
    paper: str  #: the paper's values, as text
    limit: float  #: the smallest of the paper's values; a result below it is better than the paper's
    value: Callable[[Flown], float]  #: value of a flight; NaN if it is unknown
    text: Callable[[float], str] = millimetres


def run(folder: Path, quick: bool = False, settings: tuple[str, ...] = ()) -> Exhibit:
    """Flies the mission; writes paper.json and figures to a folder, made if missing; `settings` are "key=value"."""
    flights = fly(*scenarios(quick, settings))
    folder.mkdir(parents=True, exist_ok=True)
    return write_exhibit(exhibit_of_flights(flights, quick, figures=draw_figures(flights, folder)), folder)


def fly(coarse: Scenario, fine: Scenario) -> Flights:
    """Flies the mission three times, in parallel on the available cores; errors as of `fly_aligned`."""
    flown = fly_in_parallel({
        "full resolution": (fly_aligned, fine),
        "coarse texture": (fly_aligned, coarse),
        "coarse texture without alignment": (fly_without_alignment, coarse),
    })  # fmt: skip
    return Flights(flown["coarse texture"], flown["coarse texture without alignment"], flown["full resolution"])


def scenarios(quick: bool, settings: tuple[str, ...] = ()) -> tuple[Scenario, Scenario]:
    plan = (*(QUICK if quick else ()), *settings)
    return load_scenario("paper_coarse", plan), load_scenario("paper", [*FINE, *plan])


def draw_figures(flights: Flights, folder: Path) -> tuple[Figure, ...]:
    aligned = {"coarse texture": flights.coarse, "full resolution": flights.fine}
    paper_sheet.draw_paths(aligned, folder / "paper_paths.png")
    paper_sheet.draw_tracks(aligned, SHOWN_TRACKS, folder / "paper_tracks.png")
    paper_sheet.draw_errors(aligned, folder / "paper_errors.png")
    paper_sheet.draw_maps(*flights, folder / "paper_maps.png")
    return tuple(Figure(f"paper_{name}.png", caption) for name, caption in CAPTIONS.items())


def exhibit_of_flights(flights: Flights, quick: bool, figures: tuple[Figure, ...] = ()) -> Exhibit:
    tables = (claims_table(flights, quick), tracks_table(flights), path_table(flights), map_table(flights))
    return Exhibit("paper", "The paper's mission: 25 tracks", _text(flights, quick), tables, figures)


def _text(flights: Flights, quick: bool) -> str:
    plan, n = flights.coarse.mission.plan, len(flights.coarse.result.keyframe_rows)
    flown = (
        f"{plan.n_tracks} tracks of two legs of {plan.swath_length_m:.1f} m, {plan.swath_spacing_m:.2f} m apart, by "
        f"vision alone: {len(flights.coarse.truth.trajectory)} frames and {n} keyframes over a texture of 3 inches at "
        "320 x 240 pixels (the paper's worst case), and once more over a fine texture at 640 x 480 pixels."
    )
    if quick:
        flown += " Quick plan: short legs, 5 frames per second, level motion without rotation."
    ended = [flight.ended for flight in flights if flight.ended]
    return " ".join([flown, *(f"A flight ended early: {reason}." for reason in ended)])


CLAIMS = (
    Claim("largest position error, tracks 1 to 5", "about 1 ft = 0.30 m", FOOT_M,
          lambda flown: _largest_of_first_tracks(flown)),
    Claim("position error at the far end, worst track after the fifth", "2 to 4 ft = 0.61 to 1.22 m", 2 * FOOT_M,
          lambda flown: _far_end(flown, 0)),
    Claim(f"the same, without the {FEW} worst tracks", "at most 1.5 ft = 0.46 m", 1.5 * FOOT_M,
          lambda flown: _far_end(flown, FEW)),
    Claim("largest error of elevation", "about 1.5 ft = 0.46 m", 1.5 * FOOT_M,
          lambda flown: _elevation_error(flown, 100)),
    Claim("error of elevation, 85 % of the map within", "0.6 ft = 0.18 m", 0.6 * FOOT_M,
          lambda flown: _elevation_error(flown, 85)),
    Claim("largest error of elevation, of the mean range 2.44 m", "20 %", 0.2,
          lambda flown: _elevation_error(flown, 100) / MEAN_RANGE_M, lambda share: percent(share, 2)),
    Claim("error of elevation, 85 % of the map, of the mean range 2.44 m", "7.5 %", 0.075,
          lambda flown: _elevation_error(flown, 85) / MEAN_RANGE_M, lambda share: percent(share, 2)),
)  # fmt: skip


def claims_table(flights: Flights, quick: bool) -> Table:
    """Returns the paper's results, ours, and which are better, except for a quick plan (legs sixty times shorter)."""
    rows: list[Row] = [("", "paper", "coarse texture", "full resolution", "better than the paper")]
    for claim in CLAIMS:
        values = [claim.value(flown) for flown in flights.aligned]
        better = [DASH if np.isnan(value) else "yes" if value < claim.limit else "no" for value in values]
        rows.append((claim.label, claim.paper, *map(claim.text, values), " / ".join(better)))
    return make_table("claims", "The paper's results", [row[:-1] for row in rows] if quick else rows)


def tracks_table(flights: Flights) -> Table:
    rows: list[Row] = [("track", "paper", "coarse, before", "coarse, after", "full resolution, before", "after")]
    found = [{row["track"]: row for row in track_metrics(f.result, f.truth)} for f in flights.aligned]
    for track in SHOWN_TRACKS:
        words = "about 0.30 m" if track <= FIRST_TRACKS else "up to 0.46 m, a few 0.61 to 1.22 m"
        values = [
            millimetres(tracks.get(track, {}).get(f"{when}_ga_rmse_m"))
            for tracks in found
            for when in ("before", "after")
        ]
        rows.append((str(track), words, *values))
    return make_table("tracks", "RMS position error of the keyframes at the end of a track, before and after GA", rows)


def path_table(flights: Flights) -> Table:
    final, f2f = ([_errors(flown, path) for flown in flights.aligned] for path in ("final", "f2f"))
    rows: list[Row] = [
        ("along the path", "paper", "coarse texture", "full resolution"),
        ("position error, RMS / largest", "Fig. 6 (a)", *(_pair(e.distance_m) for e in final)),
        ("height error, RMS / largest", "Fig. 6 (b)", *(_pair(e.position_m[:, 2]) for e in final)),
        ("heading error, RMS / largest", "Fig. 6 (c)", *(_degrees(e.heading_rad) for e in final)),
        ("position error of F2F alone, RMS / largest", "Fig. 4 (a)", *(_pair(e.distance_m) for e in f2f)),
    ]
    return make_table("path", "Errors along the path after alignment", rows)


def map_table(flights: Flights) -> Table:
    unaligned, truth = flights.unaligned, flights.unaligned.truth
    off_course_m = float(np.linalg.norm(truth.trajectory.positions - truth.reference, axis=1).max())
    without = "flown without alignment:"
    rows: list[Row] = [
        ("", "paper", "coarse texture", "full resolution"),
        ("map after alignment: area without a height", "none seen in Fig. 7 (b)",
         *(percent(holes(flown), 2) for flown in flights.aligned)),
        (f"{without} area without a height", "holes in Fig. 7 (c)", percent(holes(unaligned), 2), DASH),
        (f"{without} 85 % of the map within", DASH, millimetres(_elevation_error(unaligned, 85)), DASH),
        (f"{without} distance from the planned path, largest", DASH, millimetres(off_course_m), DASH),
    ]  # fmt: skip
    return make_table("map", "The map with and without alignment", rows)


def holes(flown: Flown) -> float:
    return float(np.isnan(flown.elevation.height_m[flown.truth.asked]).mean())


def _errors(flown: Flown, path: str = "final") -> PathErrors:
    return path_errors(getattr(flown.result, path), flown.truth.trajectory)


def _largest_of_first_tracks(flown: Flown) -> float:
    error_m = _errors(flown).distance_m
    return float(error_m[flown.truth.track[: len(error_m)] <= FIRST_TRACKS].max())


def _far_end(flown: Flown, rank: int) -> float:
    """Returns the RMS position error at the far end of a track after the first five [m], by rank (0: the largest)."""
    error_m = _errors(flown).distance_m
    tracks = range(FIRST_TRACKS + 1, flown.mission.plan.n_tracks + 1)
    found = [farthest_error_m(track, error_m, flown.truth) for track in tracks]
    values = sorted((value for value in found if value is not None), reverse=True)
    return values[rank] if rank < len(values) else np.nan


def _elevation_error(flown: Flown, percent: float) -> float:
    error = height_error(flown.elevation, flown.truth)
    found = percentile(np.abs(error[np.isfinite(error)]), percent)
    return np.nan if found is None else found


def _pair(values_m: Array) -> str:
    """Returns RMS and largest absolute value of errors (n,) [m] as text."""
    return f"{millimetres(rms(values_m))} / {millimetres(float(np.abs(values_m).max()))}"


def _degrees(values_rad: Array) -> str:
    """Returns RMS and largest absolute value of angles (n,) as text [deg]."""
    size = np.rad2deg(np.abs(values_rad))
    return f"{rms(size):.3f} / {size.max():.3f} deg"
