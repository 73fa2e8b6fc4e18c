"""Compiled code on disk follows the sources: an edit of a called function or of a constant, in any file, is seen."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

import twin.kernels

CONSTANTS = "HALF = 0.5\n"
CALLEE = """
from twin.constants import HALF
from twin.kernels import kernel

@kernel
def scale(x):
    return HALF * x
"""
CALLER = """
from twin import (  # in brackets, and by the package
    callee,
)
from twin.kernels import kernel

scale = callee.scale

@kernel(error_model="numpy")
def apply(x):
    return scale(x) + 1.0

if __name__ == "__main__":
    value = apply(8.0)
    print(value, sum(apply.stats.cache_hits.values()))
"""


@pytest.fixture
def package(tmp_path):
    """A package of two kernels and a constant in three files, with the project's `kernels.py`."""
    folder = tmp_path / "source" / "twin"
    folder.mkdir(parents=True)
    for name, text in {"__init__": "", "constants": CONSTANTS, "callee": CALLEE, "caller": CALLER}.items():
        (folder / f"{name}.py").write_text(text)
    shutil.copy(twin.kernels.__file__, folder)
    return folder


def printed(package, *arguments, **environment):
    """Returns the words that Python prints in a new process."""
    cache = {"NUMBA_CACHE_DIR": "", "XDG_CACHE_HOME": str(package.parents[1] / "cache")}
    command, variables = [sys.executable, "-B", *arguments], {**os.environ, **cache, **environment}
    done = subprocess.run(command, cwd=package.parent, env=variables, capture_output=True, text=True, check=True)
    return done.stdout.split()


def run(package, **environment):
    """Returns what the caller gives for 8, and how often its code came from the disk, in a new process."""
    value, hits = printed(package, "-m", "twin.caller", **environment)
    return float(value), int(hits)


def replace(file: Path, old, new):
    """Edits a file and keeps its length and time, which numba's own cache goes by."""
    before = file.stat()
    text = file.read_text()
    assert text.count(old) == 1 and len(old) == len(new)
    file.write_text(text.replace(old, new))
    os.utime(file, ns=(before.st_atime_ns, before.st_mtime_ns))


@pytest.mark.long
def test_an_edit_of_a_called_function_or_of_a_constant_in_another_file_is_seen(package):
    assert run(package) == (5.0, 0)
    assert run(package) == (5.0, 1)
    replace(package / "callee.py", "HALF * x", "HALF - x")
    assert run(package) == (-6.5, 0)
    replace(package / "constants.py", "0.5", "2.5")
    assert run(package) == (-4.5, 0)
    replace(package / "constants.py", "2.5", "0.5")
    assert run(package) == (-6.5, 1)


def test_kept_code_is_read_in_its_intermediate_form_only_for_another_compilation(package):
    code = "import numba; from twin.caller import apply; apply(8.0); "
    code += "library = next(iter(apply.overloads.values())).library; print(library._shared_module is None); "
    code += "print(numba.njit(lambda x: 2 * apply(x))(8.0), library._shared_module is None)"
    assert printed(package, "-c", code) == ["False", "10.0", "False"]  # compiled
    assert printed(package, "-c", code) == ["True", "10.0", "False"]  # from the disk


@pytest.mark.long
def test_whether_a_module_has_compiled_code_is_known_without_its_import(package):
    command = "-c", "from twin.kernels import has_code; print(has_code('twin.callee'))"
    assert printed(package, *command) == ["False"]
    run(package)
    assert printed(package, *command) == ["True"]
    replace(package / "constants.py", "0.5", "2.5")
    assert printed(package, *command) == ["False"]


def test_two_checkouts_of_the_same_sources_share_the_compiled_code(package):
    run(package)
    other = package.parents[1] / "other" / "twin"
    shutil.copytree(package, other)
    assert run(other) == (5.0, 1)


def test_without_a_folder_to_write_to_the_kernels_are_compiled_in_each_process(package, tmp_path):
    blocked = tmp_path / "file"
    blocked.touch()
    for _ in range(2):
        assert run(package, XDG_CACHE_HOME=str(blocked)) == (5.0, 0)
    assert not list(package.rglob("*.nbi"))


@pytest.mark.long
def test_old_versions_of_a_module_are_removed(package):
    for k in range(twin.kernels._VERSIONS_KEPT + 2):
        (package / "constants.py").write_text(f"HALF = {k}.0\n")
        run(package)
    versions = list((package.parents[1] / "cache" / "seabed-twin" / "kernels" / "twin.callee").iterdir())
    assert len(versions) == twin.kernels._VERSIONS_KEPT
    assert run(package)[1] == 1


@pytest.mark.long
def test_processes_that_compile_at_once_write_different_files(package):
    """One file with the code of the other process would be called with arguments of the wrong types."""
    run(package)
    code = "from twin.callee import scale; before = scale._cache._cache_file._load_index; "
    code += "scale._cache._cache_file._load_index = lambda: {}; scale(1); scale._cache._cache_file._load_index = before"
    variables = {**os.environ, "NUMBA_CACHE_DIR": "", "XDG_CACHE_HOME": str(package.parents[1] / "cache")}
    subprocess.run([sys.executable, "-c", code], cwd=package.parent, env=variables, check=True)
    assert run(package)[0] == 5.0
    assert len(list((package.parents[1] / "cache").rglob("callee.scale*.nbc"))) == 2
