"""Pages name metrics and keys of scenarios in words."""

import re
import tomllib
from importlib.resources import files

import pytest

from twin.judge.metrics import empty_metrics
from twin.judge.verdict import numbers_of
from twin.report.html import lines_of, render_paragraphs
from twin.report.number_formats import milliseconds
from twin.report.words import label, values_in_words, with_words, words
from twin.scenario.model import Scenario


def table():
    return tomllib.loads(files("twin.report").joinpath("words.toml").read_text())


def test_every_metric_with_words_exists():
    assert set(table()["metrics"]) - {"risk", "water.visibility_m"} <= set(numbers_of(empty_metrics()))


def test_every_key_with_words_exists():
    schema = Scenario.model_json_schema()

    def has(node, parts):
        for option in (node, *node.get("anyOf", ()), *node.get("allOf", ())):
            option = schema["$defs"][option["$ref"].rpartition("/")[2]] if "$ref" in option else option
            if option.get("type") == "array" and has(option.get("items", {}), parts):
                return True
            if not parts or (
                parts[0] in option.get("properties", {}) and has(option["properties"][parts[0]], parts[1:])
            ):
                return True
        return False

    assert not [key for key in table()["keys"] if not has(schema, key.split("."))]
    assert not has(schema, ["plan", "no_such_key"])


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("plan.altitude_m", "height above the reference plane"),
        ("lamps.0.intensity_cd", "intensity (lamp 1)"),
        ("rig.pixel_pitch_mm", "pixel pitch (rig)"),
        ("current.tide.period_s", "period (current tide)"),
        ("name", "name"),
    ],
)
def test_a_key_without_words_is_named_by_its_parts(name, text):
    assert words(name) == text


@pytest.mark.parametrize(
    ("name", "values", "text"),
    [
        ("water.visibility_m", (4.0, 8.0), "visibility 4 to 8 m"),
        ("plan.overlap_across", (0.735,), "overlap of neighbouring legs (sidelap) 73.5 %"),
        ("lamps.0.intensity_cd", (500.0, 2500.0), "intensity (lamp 1) 500 to 2500 cd"),
        ("current.velocity_mps", ([0.0, 0.0, 0.0], [-0.1, 0.1, 0.0]), "current 0 to 0.141 m/s"),
        ("water.jerlov", ("IB", "II", "IB"), "water type (Jerlov) IB, II"),
    ],
)
def test_values_have_their_unit(name, values, text):
    assert values_in_words(name, values) == text


def test_metrics_in_a_text_become_words_and_file_names_stay():
    text = with_words("study.toml: requirement not met: map.le90_m and map.completeness_area (3 of 3)")
    area = "mapped part of the asked area"
    assert (
        text == f"study.toml: requirement not met: height error on 90 % of the mapped cells (LE90) and {area} (3 of 3)"
    )
    assert label("plan.speed_mps") == "speed [m/s]" and label("water.turbidity") == "turbidity"


def test_paragraphs_have_a_title_a_text_and_items():
    paragraphs = render_paragraphs(
        "comparison_answer.txt.j2", {"names": ["a", "b"], "rows": [], "differences": {}}, "twin.report"
    )
    answer, sure, differs = paragraphs
    compared = "b compared with a: One survey of each: the differences are partly due to chance."
    assert answer.items == [compared] and sure.title == "How sure is it?" and len(sure.items) == 1
    assert (differs.text, differs.items) == ("Nothing.", [])
    first, second, third = lines_of(paragraphs).splitlines()
    assert first == compared and re.match(r"How sure is it\? To tell", second) and third.endswith("Nothing.")


def test_milliseconds_become_seconds_where_they_round_to_one():
    assert [milliseconds(value) for value in (999.4, 999.6, 1000.0)] == ["999 ms", "1.00 s", "1.00 s"]
