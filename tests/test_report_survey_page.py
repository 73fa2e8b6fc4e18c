"""Survey report: self-contained, made from the run folder alone, also for unfinished runs."""

import base64
import json
import re

import cv2
import matplotlib
import numpy as np
import pytest
from judge_synthetic import SCENARIO, write_folder

from twin.core.records import Trajectory
from twin.errors import TwinError
from twin.report import number_formats, plotting, survey_figures
from twin.report.run_folder import load_run
from twin.report.stage_tables import stage_rows, stage_times
from twin.report.style import FIGURE_STYLE
from twin.report.survey_page import sample_images, write_report

pytestmark = pytest.mark.long


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("complete") / "run")


@pytest.fixture(scope="module")
def report(folder):
    return write_report(folder).read_text()


@pytest.fixture(scope="module")
def unfinished(tmp_path_factory):
    return write_folder(tmp_path_factory.mktemp("unfinished") / "run", finished=False)


def test_a_written_run_folder_is_read_back(folder):
    run = load_run(folder)
    assert run.finished and set(run.trajectories) == {"truth", "f2f", "online", "final", "reference"}
    assert len(run.network.positions) == len(run.keyframes.frames) == 87
    assert run.network.edges.max() == 86
    dem = run.rasters["dem"]
    assert (dem.grid.west_m, dem.grid.north_m, dem.grid.cell_m) == (-2.5, 1.5, pytest.approx(0.02))
    assert np.isnan(dem.values[44, 65]) and run.rasters["mosaic"].values.shape == (150, 250, 3)
    assert run.frames_with_image() == run.keyframes.frames.tolist()


def test_the_report_is_self_contained(folder, report):
    sources = re.findall(r'(?:src|href)="([^"]{0,40})', report)
    assert len(sources) > 8 + 1 + 2
    linked = [source for source in sources if not source.startswith("data:image/")]
    assert "#error_classes" in linked and "dem.tif" in linked
    assert all((folder / source).exists() for source in linked if not source.startswith("#"))
    assert not re.search(r"https?://|@import|url\(", report)
    assert len(report) < 5_000_000


def test_the_report_contains_the_values_of_the_metrics(folder, report):
    metrics, page = json.loads((folder / "metrics.json").read_text()), report
    assert "The survey mapped" in page and "Jerlov type IB (Solonenko &amp; Mobley 2015)" in page
    for value in (metrics["trajectory"]["final"]["ate_rmse_m"], metrics["map"]["le90_m"], metrics["map"]["nmad_m"]):
        assert number_formats.length(value) in page
    for row in metrics["tracks"]:
        assert f">{number_formats.length(row['farthest_error_m'])}</td>" in page
    assert 'class="good">passed</td>' in page.replace("\n", "")
    for direction in ("along", "across"):
        assert f">{metrics['links'][direction]['count']}</td>" in page
    for stage in metrics["stages"].values():
        assert f">{number_formats.length(stage['ate_rmse_m'])}</td>" in page
    sections = "plan_view path_errors stages tracks elevation error mosaic samples network timing terms"
    sections += " answers survey_data coverage calibration residuals sections error_classes standards processing files"
    for section in sections.split():
        assert f'<section id="{section}">' in page, section


def test_the_report_uses_metrics_that_are_not_written_yet_also_without_stages_and_links(folder):
    metrics = json.loads((folder / "metrics.json").read_text()) | {"status": "aborted", "reason": "disk <full>"}
    page = write_report(folder, {k: v for k, v in metrics.items() if k not in ("links", "stages")}).read_text()
    assert "The survey was aborted: disk &lt;full&gt;." in page
    assert (
        '<section id="network">' in page
        and '<section id="stages">' not in page
        and "Eq. (2) treats the depth" not in page
    )


def test_the_report_names_the_causes_of_the_height_error(folder):
    metrics = json.loads((folder / "metrics.json").read_text())
    causes = {"stereo_error_m": 0.004, "pose_error_m": 0.003, "relief_error_m": None, "calibration_error_m": 0.0}
    metrics["map"] |= causes | {"typical_rmse_m": 0.0052}
    page = write_report(folder, metrics).read_text()
    assert "64 % is noise of the stereo matching (contrast, blur and noise of the images), 36 % is errors" in page
    assert "Together they state an error of 5.0 mm" in page and "the true one is 5.2 mm" in page
    assert "lower flight, more overlap, a longer baseline" in page


def test_the_report_of_an_unfinished_run_is_marked_as_unfinished(unfinished):
    page = write_report(unfinished).read_text()
    assert "unfinished" in page
    assert '<section id="plan_view">' in page and '<section id="elevation">' not in page


def test_a_run_without_results_has_a_report(tmp_path):
    (tmp_path / "scenario.resolved.toml").write_text('name = "bare <b>"\n')
    (tmp_path / "trajectory_truth.tum").write_text("")
    page = write_report(tmp_path).read_text()
    assert "unfinished" in page and "bare &lt;b&gt;" in page


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("metrics.json", "{broken"),
        ("dem.tif", "not a raster"),
        ("trajectory_final.tum", "1 2 3\n"),
        ("posegraph.g2o", "EDGE_SE3:QUAT 0 1\n"),
        ("scenario.resolved.toml", "= ="),
    ],
)
def test_a_damaged_file_is_named(tmp_path, name, text):
    (tmp_path / "scenario.resolved.toml").write_text("")
    (tmp_path / name).write_text(text)
    with pytest.raises(TwinError, match="cannot be read|is not JSON") as caught:
        load_run(tmp_path)
    assert caught.value.field.endswith(name)


def test_a_folder_that_is_not_a_run_is_rejected(tmp_path):
    with pytest.raises(TwinError, match="is not a run folder"):
        load_run(tmp_path)


def test_trajectories_are_read_back_from_tum_files(folder):
    run = load_run(folder)
    copy = folder / "copy.tum"
    run.trajectories["f2f"].save(copy)
    back = Trajectory.load(copy)
    np.testing.assert_allclose(back.world_from_camera, run.trajectories["f2f"].world_from_camera, atol=1e-8)


def stages(**errors_m):
    return {"stages": {stage: {"ate_rmse_m": error_m, "ate_max_m": None} for stage, error_m in errors_m.items()}}


def test_the_gain_of_a_stage_is_the_ratio_of_errors():
    rows = stage_rows(stages(f2f=0.4, chain=0.04, online=0.08, final=0.001), {})
    assert [row.gain for row in rows] == [None, pytest.approx(10), pytest.approx(0.5), pytest.approx(80)]


def test_a_stage_without_an_error_is_skipped():
    rows = stage_rows(stages(f2f=0.4, chain=None, online=0.1, final=0.0), {})
    assert [(row.stage, row.gain) for row in rows] == [("f2f", None), ("online", pytest.approx(4)), ("final", None)]


@pytest.mark.parametrize(
    ("settings", "online", "final"),
    [
        ({}, "chain, F2M, ahrs, previous GA", "all links, ahrs"),
        ({"use_f2m": False}, "chain, ahrs, previous GA / F2M disabled", "all links, ahrs"),
        ({"use_ga": False}, "chain, F2M, ahrs / GA disabled", "same as online / GA disabled"),
        (
            {"use_f2m": False, "use_ga": False},
            "chain, ahrs / F2M and GA disabled",
            "same as online / GA disabled",
        ),
    ],
)
def test_stage_rows_list_inputs_and_disabled_parts(settings, online, final):
    scenario = {"navigation": {"aiding": ["ahrs"]}, "estimate": settings}
    rows = {row.stage: row for row in stage_rows(stages(f2f=1.0, chain=1.0, online=1.0, final=1.0), scenario)}
    texts = {stage: " / ".join(filter(None, [row.inputs, row.disabled])) for stage, row in rows.items()}
    assert (texts["online"], texts["final"]) == (online, final)
    assert rows["f2f"].disabled == rows["chain"].disabled == ""


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, "–"),
        (0.00034, "0.34 mm"),
        (0.0042, "4.2 mm"),
        (0.0234, "2.3 cm"),
        (-0.5, "-50.0 cm"),
        (17.456, "17.46 m"),
    ],
)
def test_lengths_have_a_suitable_unit(value, text):
    assert number_formats.length(value) == text


def test_the_real_time_budget_is_that_of_the_paper():
    stages = {"f2f": {"count": 300, "mean_ms": 40.0, "p95_ms": 60.0, "total_s": 12.0}}
    stages |= {k: {"count": 10, "mean_ms": 30.0, "p95_ms": 30.0, "total_s": 0.3} for k in ("stereo", "f2m", "flow")}
    metrics = {"timing": {"stages": stages, "keyframes": 10}}
    rows = {row.stage: row for row in stage_times(metrics, SCENARIO.model_dump(), 15)}
    assert rows["f2f"].budget_ms == pytest.approx(1000 / 30) and rows["f2f"].within_budget is False
    work = rows["keyframe"]
    assert work.budget_ms == pytest.approx(500)  # N / frame rate = 15 / 30 s
    assert work.mean_ms == pytest.approx(90) and work.within_budget is True
    assert rows["stereo"].within_budget is None


def test_sample_images_keep_their_colours(folder):
    run = load_run(folder)
    image = cv2.imread(str(run.image_file(0, "left")), cv2.IMREAD_COLOR_RGB)
    assert image[..., 1].mean() > image[..., 2].mean() > image[..., 0].mean()  # the fixture's tint: green, blue, red

    data = base64.b64decode(sample_images(run)[0][1].split(",")[1])
    shown = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR_RGB)
    np.testing.assert_allclose(shown.mean(axis=(0, 1)), image.mean(axis=(0, 1)), atol=2)


def test_an_outlier_of_the_height_does_not_flatten_the_hill_shading():
    x, y = np.meshgrid(np.linspace(0, 20, 120), np.linspace(0, 15, 90))
    plain = np.sin(x) * np.cos(y)
    outlier = plain.copy()
    outlier[40, 60] = -50.0
    shaded, expected = plotting.hillshade(outlier, "gray"), plotting.hillshade(plain, "gray")
    away = np.hypot(*np.ogrid[-40:50, -60:60]) > 2
    # not equal: the shading is scaled to the steepest slope, which is that of the outlier
    assert shaded[away, 0].std() == pytest.approx(expected[away, 0].std(), rel=0.1)
    assert np.abs(shaded[away] - expected[away]).max() < 0.2


@pytest.mark.parametrize("figure", [survey_figures.path_error_curves])
def test_tick_labels_of_a_logarithmic_axis_are_plain_numbers(folder, figure):
    with matplotlib.rc_context(FIGURE_STYLE):
        drawn = figure(load_run(folder))
        drawn.canvas.draw()
        labels = [label.get_text() for axes in drawn.axes for label in axes.get_yticklabels(which="both")]
    assert any(labels) and not any("$" in label for label in labels)
