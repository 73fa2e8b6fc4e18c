"""The benchmark: the floor of the rendering shows the same floor, the gate, and the accepted values themselves."""

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from twin.bench.measurement import BenchmarkRow, child_ms, child_ms_and_peak_mb
from twin.bench.plain_renderer import PlainRenderer
from twin.bench.report import as_json, read_accepted, table
from twin.core import geometry
from twin.errors import ScenarioError, TwinError
from twin.imaging.scene.renderer import Renderer
from twin.scenario.file import load_scenario
from twin.world.mission import load_terrain

ACCEPTED = Path(__file__).parent / "benchmarks.toml"
ROWS = [
    BenchmarkRow("render", "ms", [2.0, 4.0, 9.0], "a library", [1.0, 2.0, 3.0]),
    BenchmarkRow("size", "MB", [10.0]),
    BenchmarkRow("GA", "ms", [], "gtsam: not installed"),
]


def test_the_plain_renderer_shows_the_albedo_of_the_renderer_of_surveys():
    scenario = load_scenario("reef", ["terrain.size_m=[4.0,3.2]", 'rig.model="ideal"'])
    terrain, rig = load_terrain(scenario), scenario.believed_rig()
    pose = geometry.pose(geometry.BODY_FROM_DOWN_CAMERA, np.array([0.1, -0.2, 1.6]))
    with PlainRenderer(terrain, rig) as plain:
        shown = plain.render(pose).astype(int)
    albedo, _ = Renderer(terrain, rig.width_px, rig.height_px, rig.focal_px).render(pose)
    assert np.abs(shown - albedo).mean() < 0.5 < albedo.std()


def test_a_row_compares_round_by_round():
    assert ROWS[0].spread == [2.0, 2.0, 3.0] and ROWS[1].spread == [10.0] * 3 and ROWS[2].spread == []


@pytest.mark.parametrize(
    ("accepted", "line"),
    [
        ("value = 1.9, tolerance = 0.1", ""),
        ("value = 1.5, tolerance = 0.1", "render: 2, limit 1.65 (accepted: 1.5)"),
        ('value = 1.5, tolerance = 0.1, better = "higher"', ""),
        ('value = 3.0, tolerance = 0.1, better = "higher"', "render: 2, limit 2.7 (accepted: 3)"),
        ('value = 3.0, tolerance = 0.1, better = "same"', "render: 2, limit 2.7 (accepted: 3)"),
        ("value = 3.0, tolerance = 0.1", ""),
    ],
)
def test_the_gate_names_row_value_and_limit(tmp_path, accepted, line):
    (tmp_path / "a.toml").write_text(f"[rows]\nrender = {{ {accepted} }}\nGA = {{ value = 1.0, tolerance = 0.1 }}\n")
    assert read_accepted(tmp_path / "a.toml").problems(ROWS) == ([line] if line else [])


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ("[rows]\n\nrender = { value = 1.0 }", "a.toml:3: rows.render.tolerance"),
        ("[rows]\nrender = { value = -1.0, tolerance = 0.1 }", "a.toml:2: rows.render.value"),
        ("rows = 3", "a.toml:1: rows"),
        ("[rows", "a.toml:1: not TOML"),
    ],
)
def test_a_wrong_file_of_accepted_values_is_reported_with_line_and_key(tmp_path, text, error):
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(ScenarioError) as raised:
        read_accepted(tmp_path / "a.toml")
    assert error in str(raised.value)


def test_json_and_table_have_every_measured_row():
    tree = json.loads(json.dumps(as_json(ROWS, ["a problem"])))
    assert [row["name"] for row in tree["rows"]] == ["render", "size", "GA"] and tree["problems"] == ["a problem"]
    assert tree["rows"][0]["spread"] == {"median": 2.0, "min": 2.0, "max": 3.0} and tree["rows"][2]["spread"] == {}
    assert table(ROWS)[1] == ("render", "4 ms", "2 ms", "2", "2 to 3", "a library")


def test_time_and_memory_of_a_process_are_its_own_and_a_failure_is_an_error():
    """The memory of this process is larger, which `ru_maxrss` would return."""
    assert child_ms("-c", "sum(range(3_000_000))") > 10
    assert 200 < child_ms_and_peak_mb("block = b'1' * 200_000_000")[1] < 240
    assert child_ms_and_peak_mb("sum(range(3_000_000))")[0] > 10
    with pytest.raises(TwinError, match="ended with exit status 3"):
        child_ms("-c", "raise SystemExit(3)")


@pytest.mark.slow
def test_the_benchmark_is_within_the_accepted_values():
    command = [sys.executable, "-m", "twin", "bench", "--full", "--against", str(ACCEPTED)]
    done = subprocess.run([*command, "--json"], capture_output=True, text=True)
    found = json.loads(done.stdout)
    assert done.returncode == 0, found["problems"]
    assert read_accepted(ACCEPTED).rows.keys() <= {row["name"] for row in found["rows"]}
