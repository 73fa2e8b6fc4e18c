"""`twin new-plugin` writes packages that are installed by pip and fly."""

import importlib.util
import re
import subprocess
import sys
from pathlib import Path

import pytest

from twin.errors import TwinError
from twin.plugin import skeleton

ROOT = Path(__file__).parent.parent


def install(folder, target):
    """Installs the package in a folder into a folder of its own, without network."""
    pip = [sys.executable, "-m", "pip", "install", "--no-deps", "--no-build-isolation", "--no-index", "--quiet"]
    subprocess.run([*pip, "--target", str(target), str(folder)], check=True, capture_output=True, text=True)


def run_tests(folder, target):
    """Runs the tests of a package in a process that finds the package only in `target`."""
    paths = [str(target), str(ROOT)]
    code = f"import sys; sys.path[:0] = {paths}; import pytest; sys.exit(pytest.main(sys.argv[1:]))"
    options = ["-q", "-p", "no:cacheprovider", "--rootdir", str(folder), str(folder / "tests")]
    done = subprocess.run([sys.executable, "-c", code, *options], capture_output=True, text=True, cwd=target)
    assert done.returncode == 0, done.stdout[-3000:]


@pytest.mark.long
@pytest.mark.parametrize("kind", ["controller", "reader"])
def test_a_new_plugin_is_installed_by_pip_and_passes_its_own_test(tmp_path, kind):
    folder = tmp_path / f"my-{kind}"
    written = skeleton.write(kind, folder)
    assert all(file.is_file() and not re.search("@[A-Z_]+@", file.read_text()) for file in written)
    install(folder, tmp_path / "site")
    run_tests(folder, tmp_path / "site")


def test_the_readme_of_a_new_plugin_names_the_commands_that_use_it(tmp_path):
    for kind, command in (
        ("estimator", "twin replay DATASET --estimator my_plugin"),
        ("reader", "twin replay DATASET"),
    ):
        skeleton.write(kind, tmp_path / kind / "my_plugin")
        readme = (tmp_path / kind / "my_plugin" / "README.md").read_text()
        assert readme.splitlines()[-1].strip() == command and f"Plug-in ({kind}) for" in readme


@pytest.mark.long
@pytest.mark.parametrize("kind", ["estimator", "terrain"])
def test_a_new_estimator_and_a_new_terrain_fly(tmp_path, kind):
    folder = tmp_path / f"my_{kind}"
    skeleton.write(kind, folder)
    install(folder, tmp_path / "site")
    run_tests(folder, tmp_path / "site")


@pytest.mark.parametrize(
    ("folder", "message"),
    [
        ("3d", "gives no name"),
        ("class", "gives no name"),
        ("numpy", "already installed"),
        ("twin", "already installed"),
    ],
)
def test_a_folder_that_names_no_package_is_refused(tmp_path, folder, message):
    with pytest.raises(TwinError, match=message):
        skeleton.write("terrain", tmp_path / folder)
    assert not (tmp_path / folder).exists()


def test_a_calibration_that_the_new_reader_cannot_read_may_be_replaced_by_the_user(tmp_path):
    """As the interface `Reader` demands, an error in the calibration is returned, not raised."""
    skeleton.write("reader", tmp_path / "pairs_reader")
    spec = importlib.util.spec_from_file_location("made", tmp_path / "pairs_reader" / "pairs_reader" / "__init__.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    (tmp_path / "pairs.csv").write_text("time_s,left,right\n0.0,l0.png,r0.png\n")
    dataset = module.Reader().read(tmp_path)
    assert len(dataset.images) == 1
    assert isinstance(dataset.calibration, TwinError) and "calibration.yaml" in str(dataset.calibration)


def test_a_word_that_is_no_kind_is_refused():
    with pytest.raises(
        TwinError, match="'pilot' is no kind of plug-in .allowed: controller, estimator, terrain, reader"
    ):
        skeleton.plugin_kind("pilot")
