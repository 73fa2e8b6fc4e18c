"""Every kind of page is whole: texts of its figures do not overlap, nothing is cut off at any width or on paper."""

import html
import itertools
import json
import re
import shutil
import subprocess
from pathlib import Path

import cv2
import numpy as np
import pytest
import recorded_datasets as recorded
import test_study_agreement as gate
import test_study_tuning as tuning
from judge_synthetic import write_folder, write_tif
from matplotlib.backends.backend_agg import RendererAgg
from study_surveys import STUDY, fly, study_of

import twin
from twin.exchange.geotiff import read_raster
from twin.products.pages import change_of, products_of
from twin.recordings.replay import ReplayOptions
from twin.report import run_comparison, survey_page
from twin.reproduce.exhibit import PAGE_FILE, read_all, write_all
from twin.studies.analysis import StudyAnalysis
from twin.studies.report import write_report
from twin.studies.results_log import ResultsLog
from twin.studies.surveys import survey_keys, surveys
from twin.tuning.tuning_report import write_tuning_report

pytestmark = pytest.mark.long

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FLAGS = (
    "--headless --no-sandbox --disable-gpu --disable-quic --no-first-run --disable-background-networking"
    " --disable-component-update --disable-sync --hide-scrollbars --allow-file-access-from-files"
    " --enable-logging=stderr --virtual-time-budget=60000"
).split()
WIDTHS_PX = (1400, 800, 420)
#: A4 between the margins of a browser, in CSS pixels (96 per inch).
PAPER_PX = 718
SHOWN_METRICS = '["map.le90_m", "map.le90_area_m", "trajectory.final.ate_rmse_m", "map.sigma_ratio", "map.nmad_m"]'
#: Measures pages in frames of given widths, on paper by the rules for print, with all folded texts unfolded.
SCRIPT = """
const found = {};
async function measure(url, width, paper) {
  const frame = document.createElement("iframe");
  frame.style = `width: ${width}px; height: 900px; border: 0`;
  frame.src = url;
  document.body.append(frame);
  await new Promise(done => frame.onload = done);
  const page = frame.contentDocument, root = page.documentElement;
  for (const sheet of page.styleSheets) for (const rule of sheet.cssRules)
    if (paper && rule.media && rule.media.mediaText === "print") rule.media.mediaText = "all";
  page.querySelectorAll("details").forEach(one => one.open = true);
  const cut = [...page.body.querySelectorAll("*")].filter(one =>
    one.getBoundingClientRect().right > root.clientWidth + 1 ||
    (one.scrollWidth > one.clientWidth + 1 && getComputedStyle(one).overflowX !== "visible"));
  const loaded = frame.contentWindow.performance.getEntriesByType("resource").map(one => one.name);
  found[`${url} ${width}`] = {
    overflow: Math.max(0, root.scrollWidth - root.clientWidth),
    cut: cut.map(one => one.outerHTML.slice(0, 160)),
    requests: loaded.filter(name => !/^(data|file):/.test(name)),
  };
  frame.remove();
}
(async () => {
  for (const [url, width, paper] of PLAN) await measure(url, width, paper);
  document.getElementById("found").textContent = JSON.stringify(found);
})();
"""


def survey(folder):
    run = write_folder(folder / "run")
    metrics = json.loads((run / "metrics.json").read_text())
    metrics["require"]["consistency.within_2sigma_position"] = {"value": 0.9, "limit": 0.95, "passed": False}
    (run / "metrics.json").write_text(json.dumps(metrics))
    return survey_page.write_report(run)


def replay(folder):
    path = recorded.poses(10)
    recorded.write_euroc(folder, recorded.frames(path), path)
    return survey_page.write_report(twin.replay(folder, folder / "run", ReplayOptions(outputs=())).folder)


def compared(folder):
    runs = [write_folder(folder / "survey")]
    runs += [Path(shutil.copytree(runs[0], folder / f"survey_with_a_long_name_{k}")) for k in range(5)]
    page = folder / "compare.html"
    page.write_text(run_comparison.render(run_comparison.load_runs(runs)))
    return page


def study(folder):
    done = study_of(folder, STUDY, ("samples = 12", "samples = 64"), ('["map.le90_m"]', SHOWN_METRICS))
    log = ResultsLog(folder)
    for one in surveys(done, folder):
        row, error_m = fly(one), 1e-3 * (1 + one.sample)
        log.add(row | {name: row["map.le90_m"] and error_m for name in json.loads(SHOWN_METRICS)[1:]})
    write_report(StudyAnalysis(log.table(set(survey_keys(done))), done), folder / "study.html")
    return folder / "study.html"


def agreement(folder):
    analysis = gate.analyse(folder)
    write_report(analysis, folder / "study.html")
    return folder / "study.html"


def tuned(folder):
    found = study_of(folder, tuning.TUNING)
    write_tuning_report(tuning.search(found, folder / "out"), folder)
    return folder / "tuning.html"


def reproduction(folder):
    exhibits, quick = read_all(Path(__file__).parents[1] / "docs" / "reproduction.json")
    write_all(exhibits, folder, quick)
    for exhibit in exhibits:
        (folder / exhibit.name).mkdir()
        for figure in exhibit.figures:
            cv2.imwrite(str(folder / exhibit.name / figure.file), np.zeros((400, 1600), np.uint8))
    return folder / PAGE_FILE


def products(folder):
    return products_of(write_folder(folder / "run")).write(folder / "products")


def change(folder):
    """Change between two surveys of the synthetic floor, of which a part grew by 6 cm before the second."""
    rng = np.random.default_rng(2)
    runs = [write_folder(folder / name) for name in ("first", "second")]
    for name in ("dem", "dem_truth"):
        raster = read_raster(runs[1] / f"{name}.tif")
        raster.values[60:90, 100:140] += 0.06
        raster.values[:] += rng.normal(0, 0.008, raster.values.shape) * (name == "dem")
        write_tif(runs[1] / f"{name}.tif", raster.grid, raster.values[None])
    return change_of(*runs, 0.2).write(folder / "change")


KINDS = (survey, replay, compared, study, agreement, tuned, reproduction, products, change)


@pytest.fixture(scope="module")
def drawn():
    """Texts of all figures that the pages of this module draw: (figure, text, box in pixels, whether oblique)."""
    return {}


@pytest.fixture(scope="module")
def pages(tmp_path_factory, drawn):
    draw_text = RendererAgg.draw_text

    def recorded_draw(self, gc, x, y, s, prop, angle, ismath=False, mtext=None):
        if mtext is not None:
            drawn[id(mtext)] = mtext, mtext.get_window_extent(self), angle % 90 != 0
        draw_text(self, gc, x, y, s, prop, angle, ismath, mtext)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(RendererAgg, "draw_text", recorded_draw)
        return {kind.__name__: kind(tmp_path_factory.mktemp(kind.__name__)) for kind in KINDS}


def test_no_text_of_a_figure_overlaps_another_or_is_raw_markup(pages, drawn):
    upright = [(text, box.padded(-1)) for text, box, oblique in drawn.values() if not oblique]
    assert len(upright) > 300
    assert not [text.get_text() for text, _ in upright if "\\math" in text.get_text()]
    overlapping = [
        (one.get_text(), other.get_text())
        for (one, box), (other, other_box) in itertools.combinations(upright, 2)
        if one.figure is other.figure and box.overlaps(other_box)
    ]
    assert not overlapping


def browse(folder, *arguments):
    """Runs Chromium with an empty profile; returns its output and what pages wrote to the console."""
    command = [CHROMIUM, *FLAGS, f"--user-data-dir={folder / 'profile'}", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=True)
    return done.stdout, [line for line in done.stderr.splitlines() if "CONSOLE" in line]


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
def test_no_page_is_cut_off_at_any_width_or_on_paper_or_loads_anything(pages, tmp_path):
    plan = [(page.as_uri(), width, False) for page in pages.values() for width in WIDTHS_PX]
    plan += [(page.as_uri(), PAPER_PX, True) for page in pages.values()]
    host = tmp_path / "host.html"
    script = f"const PLAN = {json.dumps(plan)};{SCRIPT}"
    host.write_text(f'<!doctype html><body><pre id="found"></pre><script>{script}</script></body>')
    output, console = browse(tmp_path, "--dump-dom", host.as_uri())
    found = json.loads(html.unescape(re.findall(r'id="found">(.*?)</pre>', output, re.DOTALL)[0]))
    assert len(found) == len(plan)
    assert not console
    assert not {key: value for key, value in found.items() if any(value.values())}


@pytest.mark.skipif(CHROMIUM is None, reason="Chromium is not installed")
@pytest.mark.parametrize("kind", [kind.__name__ for kind in KINDS])
def test_a_page_prints(pages, tmp_path, kind):
    browse(tmp_path, "--no-pdf-header-footer", f"--print-to-pdf={tmp_path / 'page.pdf'}", pages[kind].as_uri())
    assert (tmp_path / "page.pdf").read_bytes().startswith(b"%PDF")
