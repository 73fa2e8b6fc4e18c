"""Skeleton of a package with a plug-in, written by `twin new-plugin`: pyproject.toml, README.md, module and test."""

import importlib.util
import keyword
import re
from importlib.resources import files
from pathlib import Path
from typing import Literal

from twin.errors import TwinError

Kind = Literal["controller", "estimator", "terrain", "reader"]


#: Survey that the test of a skeleton flies with the plug-in: section of the key `plugin`, imaging.fidelity, and largest
#: RMSE of the trajectory and of the cross-track error that the test accepts [m].
_FLOWN: dict[str, dict[str, str]] = {
    "controller": {"SECTION": "control", "FIDELITY": "surrogate", "ERROR_M": "0.05"},
    "estimator": {"SECTION": "estimate", "FIDELITY": "rendered", "ERROR_M": "0.15"},
    "terrain": {"SECTION": "terrain", "FIDELITY": "surrogate", "ERROR_M": "0.05"},
}
KINDS: tuple[Kind, ...] = ("controller", "estimator", "terrain", "reader")


def plugin_kind(text: str) -> Kind:
    for kind in KINDS:
        if text == kind:
            return kind
    raise TwinError("new-plugin", f"{text!r} is no kind of plug-in", ", ".join(KINDS))


def package_name(folder: Path) -> str:
    """Returns the lower-case package name of a folder, "_" for ".", "-", space; raises TwinError if wrong or taken."""
    name = re.sub(r"[\s.-]+", "_", folder.absolute().name).lower()
    if not re.fullmatch(r"[a-z][a-z0-9_]{0,60}", name) or keyword.iskeyword(name):
        allowed = "letters, digits and underscores, starting with a letter"
        raise TwinError("new-plugin", f"{folder.absolute().name!r} gives no name of a Python package", allowed)
    if importlib.util.find_spec(name) is not None:
        raise TwinError("new-plugin", f"a package called {name} is already installed", "a folder of another name")
    return name


def write(kind: Kind, folder: Path) -> list[Path]:
    """Writes a package with a working plug-in and its test into a new or empty folder, and returns its files."""
    package = package_name(folder)
    flown = _FLOWN.get(kind)
    use = f"    twin run quickstart --set {flown['SECTION']}.plugin={package}" if flown else "    twin replay DATASET"
    if kind == "estimator":
        use += f"\n    twin replay DATASET --estimator {package}"
    values = {
        "NAME": package.replace("_", "-"),
        "KIND": kind,
        "PACKAGE": package,
        "CLASS": kind.capitalize(),
        "USE": use,
        **(flown or {}),
    }
    templates = {
        "pyproject.toml": "pyproject.toml",
        "README.md": "README.md",
        f"{package}/__init__.py": f"{kind}.py",
        f"tests/test_{package}.py": "test_survey.py" if flown else "test_reader.py",
    }
    written: list[Path] = []
    for name, template in templates.items():
        file = folder / name
        file.parent.mkdir(parents=True, exist_ok=True)
        text = files("twin.plugin").joinpath(f"skeletons/{template}.txt").read_text(encoding="utf-8")
        file.write_text(re.sub(r"@([A-Z_]+)@", lambda found: values[found[1]], text), encoding="utf-8")
        written.append(file)
    return written
