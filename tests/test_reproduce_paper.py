"""Tables of the paper's mission and budget: every row of the paper, and values against closed forms."""

import pickle
from contextlib import nullcontext
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from judge_synthetic import survey

from twin.core.interrupts import StageGuard
from twin.core.records import Trajectory
from twin.core.timing import Stopwatch
from twin.errors import ScenarioError, SurveyAborted, TwinError
from twin.reproduce import paper_flight, paper_sheet
from twin.reproduce.paper import CLAIMS, SHOWN_TRACKS, Flights, exhibit_of_flights, holes, scenarios
from twin.reproduce.paper_budget import FRAME_MS, KEYFRAME_MS, MODULES, N_FRAMES, budget_table, keyframe_load_ms
from twin.reproduce.paper_flight import F2fNavigator, Flown, finished_map


def flown(seed=0):
    result, elevation, truth, _ = survey(seed)
    plan = SimpleNamespace(n_tracks=2, swath_length_m=4.0, swath_spacing_m=0.5)
    mission = SimpleNamespace(plan=plan, grid=elevation.grid)
    return Flown(mission, result, elevation, truth, Stopwatch().summary())


@pytest.fixture(scope="module")
def flights():
    return Flights(flown(0), flown(1), flown(2))


def test_the_tables_have_every_row_of_the_paper(flights):
    exhibit = exhibit_of_flights(flights, quick=True)
    labels = [row[0] for row in exhibit.table("claims").rows]
    assert labels[1:] == [claim.label for claim in CLAIMS] and len(labels) == 8
    for words in ("1 ft", "2 to 4 ft", "1.5 ft", "0.6 ft", "20 %", "7.5 %"):
        assert any(words in row[1] for row in exhibit.table("claims").rows), words
    assert [row[0] for row in exhibit.table("tracks").rows[1:]] == [str(track) for track in SHOWN_TRACKS]
    assert {row[1] for row in exhibit.table("path").rows[1:]} == {
        "Fig. 6 (a)",
        "Fig. 6 (b)",
        "Fig. 6 (c)",
        "Fig. 4 (a)",
    }
    assert "Quick plan" in exhibit.text and "Quick plan" not in exhibit_of_flights(flights, quick=False).text
    for table in exhibit.tables:
        assert len({len(row) for row in table.rows}) == 1, table.key


def test_tracks_that_were_not_flown_have_a_dash(flights):
    rows = {row[0]: row[2:] for row in exhibit_of_flights(flights, quick=True).table("tracks").rows}
    assert rows["25"] == ("-", "-", "-", "-") and "-" not in rows["2"]


def with_path(item, offset_m):
    poses = item.truth.trajectory.world_from_camera.copy()
    poses[1:, 0, 3] += offset_m[1:]
    final = Trajectory(item.truth.trajectory.times_s, poses)
    result = SimpleNamespace(**(vars(item.result) | {"final": final}))
    return Flown(item.mission, result, item.elevation, item.truth, item.stages)


def test_position_claims_are_the_errors_of_the_path(flights):
    item = flights.coarse
    track = item.truth.track
    found = with_path(item, np.where(track <= 1, 0.1, 0.7))
    assert CLAIMS[0].value(found) == pytest.approx(0.7)  # both tracks belong to the first five
    assert np.isnan(CLAIMS[1].value(found)) and np.isnan(CLAIMS[2].value(found))
    later = SimpleNamespace(**(vars(item.truth) | {"track": track + 5}))
    plan = SimpleNamespace(plan=SimpleNamespace(n_tracks=7), grid=item.mission.grid)
    found = Flown(plan, found.result, item.elevation, later, item.stages)
    assert CLAIMS[1].value(found) == pytest.approx(0.7) and np.isnan(CLAIMS[2].value(found))


def test_map_claims_are_the_largest_and_the_85th_percentile_of_the_absolute_error(flights):
    item = flights.coarse
    error = np.abs((item.elevation.height_m - item.truth.height_m)[item.truth.seen])
    error = error[np.isfinite(error)]
    assert CLAIMS[3].value(item) == pytest.approx(error.max())
    assert CLAIMS[4].value(item) == pytest.approx(np.quantile(error, 0.85))


def test_holes_are_the_share_of_the_asked_area_without_a_height(flights):
    item = flights.coarse
    missing = np.isnan(item.elevation.height_m) & item.truth.asked
    assert holes(item) == pytest.approx(missing.sum() / item.truth.asked.sum()) and holes(item) > 0


def test_worse_than_the_paper_is_said_so(flights):
    bad = with_path(flights.coarse, np.full(len(flights.coarse.truth.track), 0.4))
    rows = exhibit_of_flights(Flights(bad, flights.unaligned, flights.fine), quick=False).table("claims").rows
    assert rows[1][-1] == "no / yes"
    assert rows[2][2:] == ("-", "-", "- / -")  # two tracks: none after the fifth


def test_a_quick_plan_claims_nothing_about_the_paper(flights):
    whole, quick = (exhibit_of_flights(flights, quick).table("claims").rows for quick in (False, True))
    assert whole[0][-1] == "better than the paper" and quick == tuple(row[:-1] for row in whole)


class NoKeyframes:
    """A navigator whose alignment fails and that has no map."""

    def __init__(self, *_, elevation=None):
        self.finished, self.elevation = 0, elevation

    def __enter__(self):
        return self

    def __exit__(self, *_):
        pass

    def finish(self):
        self.finished += 1
        if self.finished == 1:
            raise SurveyAborted("global alignment failed: singular matrix")
        return "result"

    def abandon_alignment(self):
        pass

    def build_map(self, result, grid):
        return self.elevation


@dataclass
class TruthStandIn:
    albedo: object = len


def fly_without_world(monkeypatch, navigator):
    world = SimpleNamespace(truth=TruthStandIn)
    monkeypatch.setattr(paper_flight, "open_world", lambda *_: nullcontext(world))
    monkeypatch.setattr(paper_flight, "fly", lambda *_: None)
    return paper_flight._fly(SimpleNamespace(grid=None, n_frames=1), lambda *_: navigator)


def test_a_failed_alignment_leaves_a_map_and_its_reason(monkeypatch):
    found = fly_without_world(monkeypatch, NoKeyframes(elevation="map"))
    assert found.elevation == "map" and found.ended == "global alignment failed: singular matrix"


def test_a_flight_without_a_keyframe_is_one_line(monkeypatch):
    with pytest.raises(TwinError, match=r"no stereo pair became a keyframe \(global alignment failed: singular matrix"):
        fly_without_world(monkeypatch, NoKeyframes())


def test_an_interrupted_alignment_ends_the_experiment():
    def interrupt():
        raise KeyboardInterrupt

    navigator = SimpleNamespace(finish=interrupt, abandon_alignment=lambda: setattr(navigator, "finish", lambda: None))
    with pytest.raises(KeyboardInterrupt):
        finished_map(navigator, None, StageGuard())


@pytest.mark.long
def test_the_figures_are_drawn(flights, tmp_path):
    both = {"coarse": flights.coarse, "fine": flights.fine}
    paper_sheet.draw_paths(both, tmp_path / "a.png")
    paper_sheet.draw_tracks(both, SHOWN_TRACKS, tmp_path / "b.png")
    paper_sheet.draw_errors(both, tmp_path / "c.png")
    paper_sheet.draw_maps(*flights, tmp_path / "d.png")
    assert all((tmp_path / f"{name}.png").stat().st_size > 10_000 for name in "abcd")


def test_the_quick_plan_keeps_25_tracks_at_the_spacing_of_the_paper():
    for scenario, width in zip(scenarios(quick=True), (320, 640), strict=True):
        assert scenario.plan.tracks == 25 and scenario.plan.area_m[1] == 30.48
        assert scenario.rig.image_width_px == width and scenario.navigation.aiding == ()
        assert scenario.imaging.fidelity == "rendered"


def test_the_f2f_navigator_reports_the_f2f_pose_and_does_not_align(monkeypatch):
    from twin.core.records import Estimate
    from twin.estimate.pipeline import Navigator

    f2f = np.eye(4) * 3
    monkeypatch.setattr(Navigator, "update", lambda *_: Estimate(0.0, np.eye(4), f2f, np.zeros(6), 0.1, "ok"))
    monkeypatch.setattr(Navigator, "align_track", lambda *_: pytest.fail("aligned"))
    navigator = object.__new__(F2fNavigator)
    np.testing.assert_array_equal(navigator.update(None).world_from_camera, f2f)
    navigator.align_track(1)


STAGES = {
    "f2f": {"count": 301, "mean_ms": 10.0, "p95_ms": 12.0, "total_s": 3.01},
    "f2m": {"count": 20, "mean_ms": 30.0, "p95_ms": 40.0, "total_s": 0.6},
    "stereo": {"count": 20, "mean_ms": 50.0, "p95_ms": 60.0, "total_s": 1.0},
    "flow": {"count": 40, "mean_ms": 20.0, "p95_ms": 60.0, "total_s": 0.8},
    "network": {"count": 120, "mean_ms": 5.0, "p95_ms": 6.0, "total_s": 0.6},
}


def test_the_budget_has_every_module_of_the_paper_and_its_load_is_the_sum_of_15_frames_and_a_keyframe():
    rows = budget_table(STAGES, 301, 20).rows
    names = [row[0].split(",")[0].split(" ")[0] for row in rows[1:9]]
    assert names == ["F2F", "F2M", "MfRP", "SD", "OF", "KPNME", "GA", "3-D"]
    # per keyframe: 15 x 10 + 30 + 50 + 40 + 30 = 300 ms of 500: 50 frames per second
    assert keyframe_load_ms(STAGES, 301, 20) == pytest.approx(300)
    assert rows[-2][3:] == ("300 ms", "500 ms", "60 %") and rows[-1][3] == "50 Hz"
    assert rows[1][3:] == ("10.0 ms per frame", "33.3 ms", "30 %")
    assert pytest.approx(KEYFRAME_MS) == FRAME_MS * N_FRAMES and len(MODULES) == 8


def test_a_budget_without_calls_has_dashes():
    rows = budget_table({}, 0, 0).rows
    assert all(row[2] == "-" for row in rows[1:]) and rows[-1][3] == "-"


@pytest.mark.parametrize("error", [TwinError("rig", "is odd", "a rig"), TwinError("a", "b"), ScenarioError(["x", "y"])])
def test_an_error_of_a_flight_in_another_process_keeps_its_message(error):
    copy = pickle.loads(pickle.dumps(error))
    assert type(copy) is type(error) and str(copy) == str(error) and vars(copy) == vars(error)
