"""Reading of text files of an untrusted data set: bounded size, YAML without code, paths inside the folder."""

import csv
import math
import re
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from twin.core import user_files
from twin.core.geometry import Array
from twin.core.user_files import resolved
from twin.errors import TwinError, described

_MOST_BYTES = 256 * 2**20  # largest list of images or poses
_MOST_YAML_BYTES = 2**20
_MOST_VALUES = 100_000  # values in a YAML file, aliases expanded
_MOST_ELEMENTS = 64  # largest matrix of a calibration file


class _CalibrationLoader(yaml.SafeLoader):
    """Loader of YAML without code, which also reads the matrices that OpenCV writes."""

    def construct_document(self, node: yaml.Node) -> Any:
        if _n_values(node, {}) > _MOST_VALUES:
            raise yaml.YAMLError(f"it has more than {_MOST_VALUES} values, or a value that contains itself")
        return super().construct_document(node)

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        names = Counter(key.value for key, _ in node.value if isinstance(key, yaml.ScalarNode))
        if repeated := [name for name, count in names.items() if count > 1]:
            raise yaml.YAMLError(f"{repeated[0][:50]!r} is given twice")
        return super().construct_mapping(node, deep)


def _n_values(node: yaml.Node, known: dict[int, float]) -> float:
    """Returns the number of values in a node, aliases expanded, given `known` ones by `id`; infinite if recursive."""
    if id(node) not in known:
        known[id(node)] = math.inf  # while its children are counted
        pairs = node.value if isinstance(node, yaml.MappingNode) else ()
        children = node.value if isinstance(node, yaml.SequenceNode) else [child for pair in pairs for child in pair]
        known[id(node)] = 1 + sum(_n_values(child, known) for child in children)
    return known[id(node)]


def _opencv_array(loader: yaml.SafeLoader, node: yaml.Node) -> list[Any]:
    """Returns the numbers of an OpenCV matrix (`rows`, `cols`, `data`), or of a vector in the form of OpenCV 5."""
    if not isinstance(node, yaml.MappingNode):
        raise yaml.YAMLError("a matrix without data")
    values = loader.construct_mapping(node, deep=True)
    data = list(values["data"])
    if not 0 < len(data) <= _MOST_ELEMENTS:
        raise yaml.YAMLError(f"a matrix has {len(data)} numbers")
    if node.tag.endswith("-nd-matrix"):
        return data
    rows, cols = int(values["rows"]), int(values["cols"])
    if len(data) != rows * cols:
        raise yaml.YAMLError(f"a matrix of {rows} rows and {cols} columns has {len(data)} numbers")
    return data


# without a decimal point, an exponent is text in YAML 1.1, but a number in JSON and YAML 1.2
_exponent = re.compile(r"^[-+]?[0-9]+[eE][-+]?[0-9]+$")
_CalibrationLoader.add_implicit_resolver("tag:yaml.org,2002:float", _exponent, [*"-+0123456789"])
for _tag in ("tag:yaml.org,2002:opencv-", "!opencv-"):
    _CalibrationLoader.add_constructor(_tag + "matrix", _opencv_array)
    _CalibrationLoader.add_constructor(_tag + "nd-matrix", _opencv_array)


def read_text(file: Path, most_bytes: int = _MOST_BYTES) -> str:
    return user_files.read_text(file, "", "a text file", most_bytes)


def read_yaml(file: Path) -> dict[str, Any]:
    """Returns the table in a YAML file, also of OpenCV; raises TwinError if it is missing, too large or not valid."""
    text = re.sub(r"\A%YAML[: ][^\n]*\n", "", read_text(file, _MOST_YAML_BYTES))
    text = text.replace("\t", " ") if file.suffix.lower() == ".json" else text  # indented by tabs, which YAML is not
    try:
        tree = yaml.load(text, Loader=_CalibrationLoader)  # a SafeLoader: it builds plain values only
    except Exception as error:  # constructors of values raise any of many types
        raise TwinError(str(file), f"is not valid YAML: {described(error)[:200]}") from None
    if not isinstance(tree, dict):
        raise TwinError(str(file), "is not a YAML table")
    return tree


def read_table(file: Path, columns: int) -> Array:
    """Returns the finite numbers (n, columns) of a text file (`read_numbered_table`)."""
    return read_numbered_table(file, columns, columns)[1]


def read_numbered_table(file: Path, columns: int, n_finite: int) -> tuple[list[int], Array]:
    """Returns the numbers of the lines of a text file, from 1, and their first columns as numbers (n, columns).

    An empty text is NaN. Lines that are empty or begin with # are ignored. Raises TwinError if the file cannot be read,
    a line has too few columns, or a value is not a number or, in the first `n_finite` columns, not finite.
    """
    lines, rows = [], []
    for number, parts in text_rows(file):
        try:
            values = [float(part) if part.strip() else np.nan for part in parts[:columns]]
        except ValueError:
            values = []
        if len(values) != columns or not np.isfinite(values[:n_finite]).all():
            raise TwinError(f"{file}:{number}", "is not a line of numbers", f"{columns} finite numbers")
        lines.append(number)
        rows.append(values)
    return lines, np.array(rows, dtype=np.float64).reshape(-1, columns)


def text_rows(file: Path) -> list[tuple[int, list[str]]]:
    """Returns line number and columns of each line of a text file, without blank lines and comments (#).

    Columns are separated by commas or white space. Raises TwinError if the file cannot be read, or a column of a line
    with commas is longer than 131072 characters.
    """
    lines = read_text(file).splitlines()
    try:
        return [
            (number, next(csv.reader([line], skipinitialspace=True)) if "," in line else line.split())
            for number, line in enumerate(lines, 1)
            if line.strip() and not line.lstrip().startswith("#")
        ]
    except csv.Error as error:
        raise TwinError(str(file), f"cannot be read: {error}", "columns separated by commas or white space") from None


def inside(folder: Path, name: str, source: Path) -> Path:
    """Returns the path of a file in a folder, given its name in a data set; the file need not exist.

    Raises TwinError, which names `source`, the file or folder that contains the name, if the path leads out of the
    folder, also by a link, or the name contains a null byte.
    """
    base = resolved(folder)
    if "\0" not in name and name == Path(name).name != ".." and not (base / name).is_symlink():
        return base / name  # the common case, without resolving the path again
    path = resolved(folder / name)
    if "\0" in name or not path.is_relative_to(base):
        raise TwinError(str(source), f"{name[:100]!r} leads out of the folder", f"files in {folder}")
    return path
