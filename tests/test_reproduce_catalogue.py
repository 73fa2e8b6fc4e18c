"""Index page, results file and chapter of `twin reproduce all`, and the errors of the commands."""

import json
from pathlib import Path

import pytest
from typer.testing import CliRunner

from twin.cli import app
from twin.errors import TwinError
from twin.reproduce import catalogue
from twin.reproduce.exhibit import (
    BEGIN,
    END,
    SHOWN,
    Exhibit,
    Figure,
    chapter,
    make_table,
    read_all,
    with_chapter,
    write_all,
)
from twin.reproduce.tank import TABLES

ROOT = Path(__file__).parent.parent
TABLE = make_table("claims", "Results", [("", "paper", "ours"), ("error < 1", "0.30 m", "8 | 9 mm")])
EXHIBIT = Exhibit("paper", "The paper's mission", "Flown once.", (TABLE,), (Figure("a.png", "A figure & more."),))


def test_results_are_read_as_they_were_written_and_the_page_has_every_table_and_figure(tmp_path):
    write_all([EXHIBIT, EXHIBIT._replace(name="tank1", title="Tank")], tmp_path, quick=True)
    exhibits, quick = read_all(tmp_path / "results.json")
    assert quick and exhibits[0] == EXHIBIT and exhibits[1].title == "Tank"
    page = (tmp_path / "index.html").read_text()
    for text in ('src="paper/a.png"', 'src="tank1/a.png"', "A figure &amp; more.", "error &lt; 1", "with quick plans"):
        assert text in page, text
    write_all([EXHIBIT], tmp_path, quick=False)
    assert "with quick plans" not in (tmp_path / "index.html").read_text()


def test_every_experiment_runs_in_its_own_folder_and_the_page_is_kept_after_each(tmp_path, monkeypatch):
    seen = []

    def experiment(name):
        def run(folder, quick):
            seen.append((name, folder, quick, (tmp_path / "index.html").exists()))
            return EXHIBIT._replace(name=name)

        return run

    monkeypatch.setattr(catalogue, "EXPERIMENTS", {name: experiment(name) for name in catalogue.EXPERIMENTS})
    lines = []
    catalogue.run_all(tmp_path, quick=True, report=lines.append)
    names = ["paper", "tank1", "tank2", "turbidity", "light", "budget"]
    assert [entry[:3] for entry in seen] == [(name, tmp_path / name, True) for name in names]
    assert [entry[3] for entry in seen] == [False, True, True, True, True, True]
    assert [line.split(":")[0] for line in lines] == names


def test_an_unknown_experiment_is_refused_before_any_is_run(tmp_path):
    with pytest.raises(TwinError, match=r"experiment: 'tank3' is unknown \(allowed: paper, tank1, tank2"):
        catalogue.run_all(tmp_path / "new", quick=True, names=("paper", "tank3"))
    assert not (tmp_path / "new").exists()


def test_the_chapter_replaces_what_is_between_the_markers_and_nothing_else():
    page = f"# A\n\n{BEGIN}\nold\n{END}\n\n## B\n"
    text = chapter([EXHIBIT], quick=False)
    new = with_chapter(page, text)
    assert (
        new.startswith(f"# A\n\n{BEGIN}\n## How true is it?") and new.endswith(f"{END}\n\n## B\n") and "old" not in new
    )
    assert with_chapter(new, text) == new
    assert "| error < 1 | 0.30 m | 8 \\| 9 mm |" in new and "--quick" not in new


@pytest.mark.parametrize("page", ["# A\n", f"{END}\n{BEGIN}\n", f"{BEGIN}\n{BEGIN}\n{END}\n", BEGIN])
def test_a_page_without_the_markers_is_refused(page):
    with pytest.raises(TwinError, match="page: does not have the markers of the chapter once"):
        with_chapter(page, "text")


def test_the_chapter_of_the_page_is_that_of_its_data_file():
    exhibits, quick = read_all(ROOT / "docs" / "reproduction.json")
    page = (ROOT / "docs" / "paper.md").read_text()
    command = "twin reproduce chapter docs/reproduction.json --page docs/paper.md"
    assert with_chapter(page, chapter(exhibits, quick)) == page, f"run: {command}"


def test_the_chapter_shows_only_tables_that_the_experiments_have():
    named = {("paper", key) for key in ("claims", "tracks", "path", "map")} | {("budget", "budget")}
    named |= {(name, key) for name, keys in TABLES.items() for key in keys}
    assert set(SHOWN) <= named


@pytest.mark.parametrize(
    ("contents", "message"),
    [
        (None, "does not exist"),
        ("{", "is not JSON"),
        ("[]", "has no list of exhibits"),
        ('{"exhibits": [1]}', "is not a result of `twin reproduce`"),
        ('{"exhibits": [{"name": "paper"}]}', "is not a result of `twin reproduce`: KeyError('tables')"),
    ],
)
def test_a_bad_results_file_is_one_clear_line(tmp_path, contents, message):
    file = tmp_path / "results.json"
    if contents is not None:
        file.write_text(contents)
    with pytest.raises(TwinError) as error:
        read_all(file)
    assert message in str(error.value) and "\n" not in str(error.value)


@pytest.mark.parametrize("name", ["paper", "tank1", "tank2", "budget", "all"])
def test_an_output_folder_that_cannot_be_written_is_refused_before_work_begins(tmp_path, name, monkeypatch):
    (tmp_path / "file").touch()
    monkeypatch.setattr(catalogue, "EXPERIMENTS", {})
    result = CliRunner().invoke(app, ["reproduce", name, "--quick", "--out", str(tmp_path / "file" / "below")])
    assert isinstance(result.exception, TwinError) and "--out: " in str(result.exception)


def test_a_command_prints_the_tables_or_json(tmp_path, monkeypatch):
    monkeypatch.setattr(catalogue, "EXPERIMENTS", {"tank1": lambda folder, quick: EXHIBIT._replace(text=str(quick))})
    text = CliRunner().invoke(app, ["reproduce", "tank1", "--quick", "--out", str(tmp_path)]).stdout
    assert "error < 1" in text and "a.png" in text
    shown = CliRunner().invoke(app, ["reproduce", "tank1", "--json", "--out", str(tmp_path)]).stdout
    assert json.loads(shown)["text"] == "False"


def test_the_chapter_is_printed_or_written(tmp_path):
    write_all([EXHIBIT], tmp_path, quick=False)
    page = tmp_path / "paper.md"
    page.write_text(f"{BEGIN}\n{END}\n")
    shown = CliRunner().invoke(app, ["reproduce", "chapter", str(tmp_path / "results.json")]).stdout
    CliRunner().invoke(app, ["reproduce", "chapter", str(tmp_path / "results.json"), "--page", str(page)])
    assert page.read_text() == shown
