"""Output paths given by the user: checks before work begins, and conversion of write errors to TwinError."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from twin.core.output_folder import check_folder, check_path, is_empty
from twin.core.user_files import resolved
from twin.errors import TwinError

if TYPE_CHECKING:
    from twin.scenario.model import Scenario

#: Largest number of bytes of the name of a scenario or study that a file name contains.
_STEM_BYTES = 100


def new_folder(folder: Path, option: str = "--out", used: bool = False) -> Path:
    check_folder(folder, option, used)
    _check_writable(folder, option)
    return folder


def unused_folder(first: Path) -> Path:
    """Returns the first of FOLDER, FOLDER-2, FOLDER-3, ... that is new or empty, checked by `new_folder`."""
    folder, count = first, 1
    while folder.exists() and not (folder.is_dir() and is_empty(folder)):
        count += 1
        folder = first.with_name(f"{first.name}-{count}")
    return new_folder(folder)


def run_folder(scenario: "Scenario", resume: bool = False) -> Path:
    """Returns the first of runs/NAME-SEED, runs/NAME-SEED-2, ... that is new or empty; to resume, the first of all."""
    first = Path("runs") / f"{file_stem(scenario.name)}-{scenario.seed}"
    return first if resume else unused_folder(first)


def resumed(scene: str | Path, out: Path | None) -> tuple[str | Path, Path | None]:
    """Returns scenario and run folder of a survey to resume, of which `scene` may be the run folder."""
    if not Path(scene).is_dir():
        return scene, out
    if out is not None and resolved(out) != resolved(Path(scene)):
        raise TwinError("--out", f"{out} is not the folder to resume, {scene}", "no --out with a run folder")
    if not (scenario := Path(scene) / "scenario.resolved.toml").is_file():
        raise TwinError(str(scene), "has no scenario.resolved.toml, so no survey to resume", "the folder of a run")
    return scenario, Path(scene)


def output_file(file: Path, option: str = "--out") -> Path:
    """Returns `file`. Raises TwinError if the path is invalid or not that of a file, or the folder is not writable."""
    check_path(file, option, "the path of a file")
    if file.exists() and not file.is_file():
        raise TwinError(option, f"{file} is not a file", "the path of a file")
    _check_writable(file, option)
    return file


@contextmanager
def writing(path: Path, option: str = "--out") -> Iterator[None]:
    """Converts an OSError in this context to a TwinError on `path`, or on the file outside it that the error names."""
    try:
        yield
    except OSError as error:
        if error.filename is not None and not resolved(Path(str(error.filename))).is_relative_to(resolved(path)):
            problem = f"cannot be read or written: {error.strerror or error}"
            raise TwinError(str(error.filename), problem, "a file that permits it") from None
        raise TwinError(option, f"{path} cannot be written: {error.strerror or error}", "a writable path") from None


def file_stem(name: str) -> str:
    """Returns a name for use in a file name: with "_" for path separators and NUL, cut off after 100 bytes."""
    text = "".join("_" if character in "/\\\0" else character for character in name)
    return text.encode("utf-8", "replace")[:_STEM_BYTES].decode("utf-8", "ignore")


def _check_writable(path: Path, option: str) -> None:
    closest = next(p for p in (path, *path.absolute().parents) if p.exists())
    folder = closest.parent if closest == path and closest.is_file() else closest
    try:
        with tempfile.TemporaryFile(dir=folder):  # permissions do not show whether the file system is writable
            pass
    except OSError:
        raise TwinError(option, f"{closest} is not writable", "a writable folder") from None
