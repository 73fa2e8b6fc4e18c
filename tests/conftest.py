"""Fixtures that several test modules share."""

import os
from pathlib import Path

import pytest

OUTSIDE_DATA = Path(os.environ.get("TWIN_DATA", "../shared/data"))
_SKIPPED_WITHOUT = "needs outside data"


@pytest.fixture(scope="session")
def outside_data():
    """Returns a function that gives the path of a file outside the project, and skips the test where it is missing."""

    def path_of(name):
        path = (OUTSIDE_DATA / name).resolve()
        if not path.is_file():
            pytest.skip(f"{_SKIPPED_WITHOUT}: {name}")
        return path

    return path_of


def pytest_terminal_summary(terminalreporter):
    """Prints one line about the tests that need data outside the project."""
    reports = [r for r in terminalreporter.stats.get("skipped", []) if _SKIPPED_WITHOUT in str(r.longrepr)]
    if reports:
        names = sorted({str(r.longrepr).rsplit(": ", 1)[1].rstrip("')") for r in reports})
        terminalreporter.write_line(
            f"{len(reports)} tests need data that TWIN_DATA did not provide: {', '.join(names)}"
        )
