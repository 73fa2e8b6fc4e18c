"""Checkpoints: a killed run goes on as if undisturbed, and what is damaged or of another run is refused."""

import ctypes
import json
import os
import pickle
import signal
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from kill_and_resume import differences, leftovers

from twin import survey
from twin.core import checkpoint
from twin.core.checkpoint import FOLDER, Checkpoints
from twin.core.interrupts import StageGuard
from twin.core.records import Frame
from twin.core.series import GrowingArray
from twin.errors import TwinError
from twin.estimate.vision.disparity import DenseMatch, Disparity
from twin.estimate.vision.image_spool import ImageSpool
from twin.estimate.vision.tiles import TiledRaster
from twin.report.frame_recorder import FrameRecorder
from twin.report.run_writer import RunFolder
from twin.scenario.file import dump_toml, input_files, load_scenario
from twin.session.assembly import checkpoints_of
from twin.session.conclusion import Estimation
from twin.studies.results_log import cut_torn_line
from twin.world.mission_flight import Flight

SMALL = [
    "terrain.size_m=[5.0, 4.0]",
    "rig.image_width_px=192",
    "rig.image_height_px=144",
    "rig.frame_rate_hz=15",
    "plan.area_m=[0.8, 0.5]",
    "plan.altitude_m=1.8",
    "control.hold_s=0.4",
]
ALL_SENSORS = 'navigation.aiding=["pressure","ahrs","dvl","usbl"]'
FAULTS = [
    {"part": "left_camera", "type": "stuck", "start_s": 4.0, "duration_s": 1.0},
    {"part": "pressure", "type": "stuck", "start_s": 2.0, "duration_s": 6.0},
    {"part": "ahrs", "type": "delayed", "start_s": 2.0, "duration_s": 6.0, "size": 0.5},
    {"part": "dvl", "type": "garbage", "start_s": 2.0, "duration_s": 6.0, "size": 0.1},
    {"part": "thruster", "type": "stuck", "start_s": 3.5, "duration_s": 1.0, "number": 1},
    {"part": "water", "type": "gust", "start_s": 2.0, "duration_s": 6.0, "size": 0.2},
    {"part": "fish", "type": "school", "start_s": 2.0, "duration_s": 6.0, "size": 4},
]


class Killed(BaseException):
    """Stands for the end of the process: nothing in the program handles it."""


@pytest.fixture
def run(tmp_path):
    (tmp_path / "dem.tif").write_bytes(b"heights")
    (tmp_path / "run").mkdir()

    def checkpoints(interval_s=1e-9, **identity):
        return Checkpoints(tmp_path / "run", {"scenario": "1a2b"} | identity, [tmp_path / "dem.tif"], interval_s)

    return checkpoints


def saved(run, state, made_anew=()):
    checkpoints = run()
    assert checkpoints.open(False, made_anew) is None
    checkpoints.save_if_due(state)
    assert checkpoints.problem == ""
    return checkpoints


def test_a_state_keeps_shared_objects_and_takes_others_from_the_program_and_the_folder(run, tmp_path):
    rng, model = np.random.default_rng(1), object()
    saved(run, {"a": rng, "b": [rng, model], "file": tmp_path / "run" / "keyframes" / "1.png"}, (None, model))
    moved = tmp_path / "moved"
    (tmp_path / "run").rename(moved)
    fresh = object()
    state = Checkpoints(moved, {"scenario": "1a2b"}, [tmp_path / "dem.tif"], 1.0).open(True, (None, fresh))
    assert state["a"] is state["b"][0] and state["b"][1] is fresh
    assert state["file"] == moved / "keyframes" / "1.png"
    assert np.array_equal(state["a"].standard_normal(3), rng.standard_normal(3))


def edit(file, old, new):
    data = file.read_bytes()
    assert old in data
    file.write_bytes(data.replace(old, new))


@pytest.mark.parametrize(
    "harm, identity, message",
    [
        (lambda f: edit(f / "state-1.pickle", b"flown", b"blown"), {}, "state-1.pickle: was edited or is damaged"),
        (lambda f: os.truncate(f / "state-1.pickle", 20), {}, "state-1.pickle: was edited or is damaged"),
        (lambda f: (f / "state-1.pickle").unlink(), {}, "state-1.pickle: is missing"),
        (lambda f: os.truncate(f / "manifest.json", 50), {}, "manifest.json: is not JSON"),
        (lambda f: edit(f / "manifest.json", b"checkpoint/1", b"checkpoint/0"), {}, "has not the schema"),
        (lambda f: edit(f / "manifest.json", b'"sha256"', b'"sha1"'), {}, "manifest.json: names no state"),
        (lambda f: None, {"scenario": "3c4d"}, "scenario: was 1a2b, is 3c4d"),
        (lambda f: None, {"numpy": "2.4"}, "manifest.json: has other identity"),
        (lambda f: edit(f.parent.parent / "dem.tif", b"heights", b"depths"), {}, "dem.tif has changed"),
    ],
)
def test_a_damaged_or_foreign_checkpoint_is_refused_with_one_line(run, tmp_path, harm, identity, message):
    saved(run, ["flown"])
    harm(tmp_path / "run" / FOLDER)
    with pytest.raises(TwinError) as error:
        run(**identity).open(True)
    assert message in str(error.value) and "\n" not in str(error.value)


def test_a_folder_with_other_contents_and_no_checkpoint_is_refused_and_an_empty_one_begins(run, tmp_path):
    assert run().open(True) is None
    (tmp_path / "run" / "notes.txt").write_text("mine")
    (tmp_path / "run" / FOLDER / "manifest.json").unlink()
    with pytest.raises(TwinError, match="has no checkpoint"):
        run().open(True)


def test_an_interval_that_is_no_time_is_refused(run):
    for wrong in (-1.0, np.nan):
        with pytest.raises(TwinError, match="checkpoint_s: .* is no time between checkpoints"):
            run(wrong)


class Breaks:
    def __init__(self, error):
        self.error = error

    def __getstate__(self):
        raise self.error


@pytest.mark.parametrize("error", [OSError(28, "No space left on device"), TypeError("cannot pickle"), Killed()])
def test_the_last_state_is_kept_if_the_next_one_fails_or_the_process_ends_within_it(run, tmp_path, error):
    checkpoints = saved(run, ["whole"])
    state = ["a" * 10_000_000, Breaks(error)]
    if isinstance(error, Killed):
        with pytest.raises(Killed):
            checkpoints.save_if_due(state)
        assert (tmp_path / "run" / FOLDER / "state-2.pickle.part").exists()
    else:
        checkpoints.save_if_due(state)
        assert str(error) in checkpoints.problem
    assert run().open(True) == ["whole"]
    checkpoints.save_if_due(["later"])
    assert run().open(True) == ["later"]
    assert sorted(file.name for file in (tmp_path / "run" / FOLDER).iterdir()) == ["manifest.json", "state-2.pickle"]


def test_checkpoints_are_a_minute_apart_or_take_a_hundredth_of_the_time(run, monkeypatch):
    now_s = [0.0]
    monkeypatch.setattr(checkpoint.time, "perf_counter", lambda: now_s[0])

    checkpoints, times_s = run(None), []

    class Slow:
        def __reduce__(self):
            times_s.append(now_s[0])
            now_s[0] += 2.0
            return list, ()

    checkpoints.open(False)
    while now_s[0] < 700:
        checkpoints.save_if_due(Slow())
        now_s[0] += 1.0
    assert times_s == [60.0, 262.0, 464.0, 666.0]
    run(0.0).save_if_due(Slow())
    run(0.0).save_last(Slow())
    assert len(times_s) == 4


def test_restored_rows_tiles_and_images_go_on_as_the_saved_ones(tmp_path):
    rows, tiles = GrowingArray(2), TiledRaster(1, tmp_path / "tiles", max_tiles=2)
    rows.append(np.arange(6.0).reshape(3, 2))
    for k in range(4):  # two of them are on the disk
        tiles.write(0, 256 * k, np.full((1, 256, 256), k, np.float32))
    data = pickle.dumps((rows, tiles))
    tiles.write(0, 0, np.full((1, 256, 1024), 9, np.float32))  # after the checkpoint
    again, restored = pickle.loads(data)
    for one in (rows, again):
        one.append([7.0, 8.0])
    assert len(data) < 1.1 * 4 * 256 * 256 * 4
    assert np.array_equal(again.array, rows.array)
    assert np.array_equal(restored.read(0, 0, 1, 1024)[0, 0], np.repeat(np.arange(4), 256))
    assert len(restored._tiles) <= 2


def test_an_image_that_was_edited_after_the_checkpoint_is_refused(tmp_path):
    spool, image = ImageSpool(tmp_path), np.zeros((8, 8, 3), np.uint8)
    spool.put(3, image, image, (image[..., 0], image[..., 0]))
    data = pickle.dumps(spool)
    assert np.array_equal(pickle.loads(data).left(3), image)
    (tmp_path / "000003_right.png").write_bytes(b"edited")
    with pytest.raises(TwinError, match="000003_right.png: was edited or is damaged: the checkpoint depends on it"):
        pickle.loads(data)


def test_the_input_files_are_those_that_the_keys_of_the_scenario_name(tmp_path):
    file = tmp_path / "model.toml"
    scenario = load_scenario("reef", [f"imaging.error_model={file}"])
    assert input_files(scenario) == [file] and input_files(load_scenario("reef")) == []


VARIANTS = {
    "faults": (ALL_SENSORS, f"faults=[{', '.join(json.dumps(one).replace(': ', '=') for one in FAULTS)}]"),
    "altimeter": ("control.height=altimeter", ALL_SENSORS),
    "gaps": ("control.height=map", "plan.fill_gaps=true", "record=all"),
    "imu": ('navigation.aiding=["imu","dvl"]', "imu.rate_hz=60", "navigation.dvl_rate_hz=5", "record=all"),
    "delays": (ALL_SENSORS, "navigation.usbl_delay_s=0.5", "navigation.pressure_delay_s=0.2", "control.latency=0.2"),
    "sea": ("snow.density_per_m3=200", "current.gust_mps=0.05", "rig.model=machine_vision_dome"),
    "kinematic": ("vehicle.dynamics=kinematic", "control.latency=0.2"),
    "surrogate": ("imaging.fidelity=surrogate",),
}


@pytest.mark.long
@pytest.mark.parametrize("name", VARIANTS)
def test_a_survey_that_was_killed_twice_ends_byte_identical(name, tmp_path):
    overrides = [key.replace('"', "'") if key.startswith("faults") else key for key in VARIANTS[name]]
    scenario = load_scenario("reef", [*SMALL, *overrides])
    survey.run(scenario, tmp_path / "whole", outputs=())
    n = len((tmp_path / "whole" / "trajectory_online.tum").read_text().splitlines())
    for number, share in enumerate((0.3, 0.7, None)):

        def progress(now, share=share):
            if share is not None and now.stage == "survey" and now.simulated_s >= share * n / 15:
                raise Killed

        every_s = 1e-9 if name == "surrogate" else 0.2
        try:
            survey.run(scenario, tmp_path / "killed", progress, outputs=(), resume=number > 0, checkpoint_s=every_s)
        except Killed:
            manifest = json.loads((tmp_path / "killed" / FOLDER / "manifest.json").read_text())
            assert manifest["state"] is not None
    assert differences(tmp_path / "whole", tmp_path / "killed") == []
    assert leftovers(tmp_path / "killed") == []


KILL_AT_STAGE = """
import os, signal, sys
from pathlib import Path
from twin import survey
from twin.scenario.file import load_scenario

def progress(now):
    if now.stage == sys.argv[2]:
        os.kill(os.getpid(), signal.SIGKILL)

survey.run(load_scenario("reef", sys.argv[3:]), Path(sys.argv[1]), progress, outputs=(), checkpoint_s=0.5)
"""


@pytest.mark.long
def test_a_survey_killed_while_it_maps_or_reports_goes_on_after_the_flight(tmp_path):
    scenario, flown = load_scenario("reef", SMALL), []
    survey.run(scenario, tmp_path / "whole", outputs=())
    for stage in ("map", "orthomosaic", "report"):
        out = tmp_path / stage
        command = [sys.executable, "-c", KILL_AT_STAGE, str(out), stage, *SMALL]
        assert subprocess.run(command, check=False).returncode == -signal.SIGKILL

        def progress(now):
            flown.append(now.stage == "survey")

        survey.run(scenario, out, progress, outputs=(), resume=True)
        assert differences(tmp_path / "whole", out) == [] and leftovers(out) == []
    assert flown and not any(flown)


@pytest.fixture
def finished(tmp_path, monkeypatch):
    """The folder of a run that was killed after it had written its metrics, but before its last files were removed."""
    files = {
        "metrics.json": "{}",
        "scenario.resolved.toml": dump_toml(load_scenario("reef", ["record=all"])),
        "checkpoint/manifest.json": "{}",
        "keyframes/000001_left.png": "",
        "keyframes/000001_disparity.npy": "",
    }
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(exist_ok=True)
        (tmp_path / name).write_text(text)
    monkeypatch.setattr(survey.RunResult, "of_folder", lambda _: survey.RunResult("complete", {}, tmp_path))
    return tmp_path


@pytest.mark.parametrize("other", [["record=none"], ["record=keyframes"], ["record=all", "seed=2"]])
def test_a_finished_run_of_another_scenario_is_not_resumed_and_keeps_its_files(finished, other):
    before = sorted(finished.rglob("*"))
    with pytest.raises(TwinError, match="has another run, which is finished"):
        survey.run(load_scenario("reef", other), finished, resume=True)
    assert sorted(finished.rglob("*")) == before


def test_a_finished_run_that_is_resumed_loses_what_only_a_run_in_progress_has(finished):
    assert survey.run(load_scenario("reef", ["record=all"]), finished, resume=True).status == "complete"
    names = sorted(file.name for file in finished.rglob("*") if file.is_file())
    assert names == ["000001_left.png", "metrics.json", "scenario.resolved.toml"]


@pytest.mark.parametrize("length", [0, 100])
def test_a_disparity_that_a_full_disk_cut_is_a_read_error(tmp_path, length):
    spool, image = ImageSpool(tmp_path), np.zeros((8, 8, 3), np.uint8)
    ones = np.ones((8, 8), np.float32)
    spool.put(3, image, image, (image[..., 0], image[..., 0]), DenseMatch(ones, Disparity(ones, ones)))
    file = tmp_path / "000003_disparity.npy"
    spool.disparity(3)
    file.write_bytes(file.read_bytes()[:length])
    with pytest.raises(OSError, match="000003_disparity.npy cannot be read"):
        spool.disparity(3)


@pytest.mark.parametrize("kind", ["spool", "recorder"])
def test_an_image_that_a_full_disk_lost_during_a_checkpoint_still_ends_the_flight(kind, tmp_path, monkeypatch):
    write, image, full = Path.write_bytes, np.zeros((8, 8, 3), np.uint8), [True]

    def write_bytes(file, data):
        if full[0] and file.suffix == ".png":
            raise OSError(28, "No space left on device", str(file))
        return write(file, data)

    monkeypatch.setattr(Path, "write_bytes", write_bytes)
    frame = Frame(0, 0.0, image, None)
    writer = ImageSpool(tmp_path / "keyframes") if kind == "spool" else FrameRecorder(tmp_path, "all")
    add = {
        "spool": lambda: writer.put(3, image, image, (image[..., 0], image[..., 0])),
        "recorder": lambda: writer.add(frame, np.eye(4), np.zeros(6)),
    }[kind]
    add()
    checkpoints = Checkpoints(tmp_path, {}, (), 1e-9)
    checkpoints.open(False)
    checkpoints.save_if_due(writer)
    assert "No space left on device" in checkpoints.problem
    full[0] = False
    with pytest.raises(OSError, match="No space left on device"):
        add()


def test_a_checkpoint_that_failed_gives_its_space_to_the_results(tmp_path):
    checkpoints = Checkpoints(tmp_path, {}, (), 1e-9)
    checkpoints.open(False)
    checkpoints.save_if_due("state")
    checkpoints.save_last(lambda: None)  # cannot be saved
    assert checkpoints.problem and not (tmp_path / FOLDER).exists()


def test_whatever_an_object_of_a_plug_in_raises_the_survey_goes_on(tmp_path):
    deep = []
    for _ in range(100_000):
        deep = [deep]
    for state in ({"pointer": ctypes.pointer(ctypes.c_int(3))}, deep):
        checkpoints = Checkpoints(tmp_path, {}, (), 1e-9)
        checkpoints.open(False)
        checkpoints.save_if_due(state)
        assert checkpoints.problem


def test_a_start_that_is_refused_for_lack_of_space_leaves_no_files(tmp_path, monkeypatch):
    def write_bytes(file, data):
        raise OSError(28, "No space left on device", str(file))

    monkeypatch.setattr(Path, "write_bytes", write_bytes)
    Checkpoints(tmp_path / "run", {}, (), 1.0).open(False)
    with pytest.raises(TwinError, match="a writable folder with space"):
        RunFolder(tmp_path / "run", load_scenario("reef"))
    assert list((tmp_path / "run").iterdir()) == []


def test_a_changed_file_of_a_plug_in_is_an_input_that_has_changed(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "myctl").mkdir()
    for name, text in {"__init__": "", "gains": "GAIN = 1.0", "control": "class Controller: pass"}.items():
        (tmp_path / "myctl" / f"{name}.py").write_text(text)
    scenario = load_scenario("reef", ["control.plugin=myctl.control:Controller"], allow_plugins=True)
    (tmp_path / "run").mkdir()
    checkpoints = checkpoints_of(scenario, tmp_path / "run", 1e-9)
    checkpoints.open(False)
    checkpoints.save_if_due("state")
    assert checkpoints_of(scenario, tmp_path / "run", 1e-9).open(True) == "state"
    (tmp_path / "myctl" / "gains.py").write_text("GAIN = 2.0")
    with pytest.raises(TwinError, match=r"the file \S*gains.py has changed"):
        checkpoints_of(scenario, tmp_path / "run", 1e-9).open(True)


def test_a_study_refuses_an_input_file_that_has_changed_and_takes_new_ones(tmp_path):
    dem, texture = tmp_path / "dem.tif", tmp_path / "sand.png"
    dem.write_bytes(b"heights")
    checkpoint.check_inputs(tmp_path, [dem])
    texture.write_bytes(b"sand")
    checkpoint.check_inputs(tmp_path, [dem, texture])
    texture.write_bytes(b"mud")
    with pytest.raises(TwinError, match="sand.png has changed since"):
        checkpoint.check_inputs(tmp_path, [dem, texture])


def test_a_flight_can_be_stored():
    """A lambda or an inner function in it would leave every survey without checkpoints."""
    assert pickle.loads(pickle.dumps(Flight(None, None))).further_path(None, None) == ()


def test_a_torn_last_line_of_a_journal_is_removed(tmp_path):
    file = tmp_path / "optuna.journal"
    cut_torn_line(file)
    file.write_bytes(b'{"op": 1}\n{"op"')
    cut_torn_line(file)
    assert file.read_bytes() == b'{"op": 1}\n'


@pytest.mark.long
@pytest.mark.parametrize("arguments", [["schema"], ["export", "--list"]])
@pytest.mark.parametrize(
    "streams, status, message", [("> /dev/full", 2, "stdout: No space left on device"), (">&-", 0, ""), ("2>&-", 0, "")]
)
def test_a_full_disk_or_a_closed_stream_costs_one_line_at_most(arguments, streams, status, message):
    command = f"{sys.executable} -m twin {' '.join(arguments)} {streams}"
    ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert ended.returncode == status
    assert ended.stderr.startswith(message) and len(ended.stderr.splitlines()) <= 1


@pytest.mark.long
def test_an_address_space_in_which_libraries_would_crash_is_one_line():
    command = f"ulimit -v 1500000; {sys.executable} -m twin schema"
    ended = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=False)
    assert ended.returncode == 2
    message = "memory: the limit of the address space (ulimit -v) is 1.5 GB (allowed: 3 GB or more)"
    assert ended.stderr.strip() == message


@pytest.mark.parametrize("lost, map_is_made", [({4}, True), ({2, 4}, False)])
@pytest.mark.parametrize("chosen", [None, np.array([False, True, True, True, True])])
def test_an_image_that_a_full_disk_lost_costs_its_part_of_the_map(lost, map_is_made, chosen):
    class Navigator:
        def build_map(self, result, grid, report, used):
            numbers = np.flatnonzero(np.ones(5, bool) if used is None else used)
            if lost & set(numbers.tolist()):
                raise OSError(28, "No space left on device")
            return numbers.tolist()

        def with_tested_sigma(self, result, elevation, used):
            return elevation

    guard = StageGuard()
    estimation = Estimation(Navigator(), None, guard, None, lambda *_: None, 0.0)
    found = estimation.build_map(SimpleNamespace(keyframe_rows=np.arange(5)), None, chosen)
    assert found == ([k for k in range(4) if chosen is None or chosen[k]] if map_is_made else None)
    assert guard.reason == "[Errno 28] No space left on device"
