"""Fixtures that several test modules share."""

import gc
import os
from pathlib import Path

import pytest

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # one test runs on each core
OUTSIDE_DATA = Path(os.environ.get("TWIN_DATA", "../shared/data"))
_SKIPPED_WITHOUT = "needs outside data"
#: Modules that take longest, in the order in which they start: before the short modules, so that the workers end at the
#: same time; the first use different compiled functions, so that workers rarely compile a function at the same time.
LONGEST = (
    "test_survey", "test_world_auv", "test_export_command", "test_simulate_sea", "test_study_verification",
    "test_checkpoint", "test_imports", "test_surrogate", "test_imaging_daylight", "test_hostile_input",
    "test_world_mission_patterns", "test_plugin_skeleton", "test_datasets_replay", "test_look", "test_plugin_flight",
    "test_orthomosaic", "test_gym", "test_imaging_materials", "test_session_stepped_world", "test_reproduce_turbidity",
    "test_terrains_objects", "test_report_mesh_picture", "test_report_survey_page",
)  # fmt: skip


@pytest.fixture(scope="session")
def outside_data():
    """Returns a function that gives the path of a file outside the project, and skips the test where it is missing."""

    def path_of(name):
        path = (OUTSIDE_DATA / name).resolve()
        if not path.is_file():
            pytest.skip(f"{_SKIPPED_WITHOUT}: {name}")
        return path

    return path_of


def pytest_collection_modifyitems(items):
    """Puts the longest modules first; `--no-loadscope-reorder` keeps this order when the modules are distributed."""
    place = {name: number for number, name in enumerate(LONGEST)}
    items.sort(key=lambda item: place.get(item.path.stem, len(place)))


def pytest_collection_finish():
    """Leaves what lives until the end (modules, tests) out of all further garbage collections."""
    gc.collect()
    gc.freeze()


def pytest_terminal_summary(terminalreporter):
    """Prints one line about the tests that need data outside the project."""
    reports = [r for r in terminalreporter.stats.get("skipped", []) if _SKIPPED_WITHOUT in str(r.longrepr)]
    if reports:
        names = sorted({str(r.longrepr).rsplit(": ", 1)[1].rstrip("')") for r in reports})
        terminalreporter.write_line(
            f"{len(reports)} tests need data that TWIN_DATA did not provide: {', '.join(names)}"
        )
