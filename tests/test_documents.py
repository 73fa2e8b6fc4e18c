"""The documents: what is generated is up to date, links lead somewhere, pages are short, commands are found."""

import re
import runpy
import subprocess
import sys
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted(DOCS.rglob("*.md"))]


def pages_of(entry):
    """Yields the pages of an entry of the navigation."""
    if isinstance(entry, str):
        yield entry
    else:
        for below in entry.values() if isinstance(entry, dict) else entry:
            yield from pages_of(below)


def anchor(heading):
    """Returns the anchor that Markdown gives a heading."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")


def test_the_reference_of_keys_is_that_of_the_models():
    pages = runpy.run_path(str(DOCS / "reference.py"))["pages"]()
    for name, page in pages.items():
        assert page == (DOCS / "reference" / name).read_text(), "run: python docs/reference.py docs/reference"
    assert (
        "| `baseline_m` | `0.15` | m | number, > 0.005, <= 3 | distance between the cameras |" in pages["scenario.md"]
    )
    assert "| `log_uniform` |" in pages["study.md"]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_a_file_and_a_heading(page):
    for target in re.findall(r"\]\(([^)\s]+)\)", page.read_text()):
        if re.match(r"https?:", target):
            continue
        name, _, section = target.partition("#")
        file = (page.parent / name).resolve() if name else page
        assert file.exists(), target
        if section:
            headings = re.findall(r"^#+ (.+)$", file.read_text(), re.MULTILINE)
            assert section in map(anchor, headings), target


def test_the_navigation_has_every_page_once():
    navigation = yaml.safe_load((ROOT / "mkdocs.yml").read_text())["nav"]
    assert sorted(pages_of(navigation)) == sorted(str(page.relative_to(DOCS)) for page in DOCS.rglob("*.md"))


def test_the_readme_fits_a_screen_or_two_and_the_findings_are_no_diary():
    assert (ROOT / "README.md").stat().st_size <= 8_000
    assert (DOCS / "findings.md").stat().st_size <= 60_000


def test_commands_are_those_of_shell_blocks_without_those_that_ran_already():
    script = runpy.run_path(str(ROOT / "tests" / "readme_commands.py"))["script"]
    page = "```sh\nmake demo # a\ntwin plan reef\n```\n\n    twin doctor\n\n```toml\na = 1\n```\n\n```sh\nls\n```\n"
    assert script(page, ["make demo"]) == "set -eux\ntwin plan reef\nls\n"


def test_every_mutant_changes_a_text_that_stands_once():
    done = subprocess.run([sys.executable, ROOT / "tests" / "mutants.py", "--check"], capture_output=True, text=True)
    assert done.returncode == 0, [line for line in done.stdout.splitlines() if " current " not in line]
