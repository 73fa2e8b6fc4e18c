"""Reading, validation and writing of scenarios as TOML files, with base files and overrides."""

from __future__ import annotations

import copy
import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

import tomlkit
from pydantic import BaseModel, ValidationError

from twin.errors import ScenarioError, TwinError
from twin.scenario.model import Scenario, Source
from twin.scenario.toml_lines import key_lines

Model = TypeVar("Model", bound=BaseModel)
_PATH_KEYS = ("imaging.error_model", "terrain.height_file", "terrain.texture_file", "water.spectrum_file")
#: Old keys of the scenario and their new names.
_RENAMED_KEYS = {"calibration": "calibration_error", "imaging.calibration": "imaging.error_model"}
_ABSENT = object()


def load_scenario(path: str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file and the files that it extends, and applies overrides.

    Args:
        path: a file, or a name in scenes/.
        overrides: strings `key=value` with a dotted key and a TOML value; a value that is not valid TOML is a string.

    Raises:
        ScenarioError: lists every error, each as `FILE:LINE: key: problem (allowed: ...)`.
    """
    tree, source, errors = _read_with_base(find_scene(path), including_files=())
    source = source.model_copy(update={"overrides": tuple(overrides)})
    for override in overrides:
        try:
            _apply_override(tree, override)
        except ScenarioError as error:
            errors += error.lines
    try:
        scenario = validated(tree, Scenario, source)
    except ScenarioError as error:
        raise ScenarioError([*errors, *error.lines]) from None
    if errors:
        raise ScenarioError(errors)
    scenario._source = source
    return scenario


def read_tree(path: str | Path) -> dict[str, Any]:
    """Returns the keys and values of a scenario, merged over its base file; the values are not validated.

    Args:
        path: a file, or a name in scenes/.

    Raises:
        ScenarioError: a file cannot be read or contains the old name of a renamed key.
    """
    tree, _, errors = _read_with_base(find_scene(path), including_files=())
    if errors:
        raise ScenarioError(errors)
    return tree


def with_values(tree: Mapping[str, Any], values: Mapping[str, Any], source: Source) -> Scenario:
    """Returns the validated scenario of a tree of keys, some of which are given new values.

    Args:
        tree: keys and values of a scenario; not modified.
        values: dotted keys and their new values; relative file paths refer to the folder of `source.path`.
        source: file that the new values come from, for error messages.

    Raises:
        ScenarioError: lists every error.
    """
    changed = copy.deepcopy(dict(tree))
    for key, value in values.items():
        if new_key := _renamed(key):
            raise ScenarioError([source.describe(TwinError(key, f"renamed to {new_key}"))])
        is_path = key in _PATH_KEYS and isinstance(value, str)
        try:
            _assign(changed, key, str(_expand(value, source.path.parent)) if is_path else value, key)
        except ScenarioError as error:
            problem = error.lines[0].removeprefix(f"{key}: ")
            raise ScenarioError([source.describe(TwinError(key, problem))]) from None
    scenario = validated(changed, Scenario, source)
    scenario._source = source
    return scenario


def validated(tree: Mapping[str, Any], model: type[Model], source: Source) -> Model:
    """Validates a tree of keys and values and returns the model. Raises ScenarioError, which lists every error."""
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        raise ScenarioError([source.describe(_as_twin_error(item, model)) for item in error.errors()]) from None


def find_scene(path: str | Path) -> Path:
    """Returns the file of a scenario.

    Args:
        path: an existing file, or a name in scenes/.

    Raises:
        ScenarioError: no such file or name exists.
    """
    import scenes

    candidate = Path(path)
    if candidate.is_file():
        return candidate
    folder = Path(scenes.__file__).parent
    names = sorted(p.stem for p in folder.glob("*.toml"))
    if str(path).removesuffix(".toml").removeprefix("scenes/") in names:
        return folder / (str(path).removesuffix(".toml").removeprefix("scenes/") + ".toml")
    raise ScenarioError(
        [f"{path}: no such scenario{_hint(str(path), names)} (allowed: a file, or one of {', '.join(names)})"]
    )


def dump_toml(scenario: Scenario) -> str:
    """Returns the scenario as the text of a TOML file, which `load_scenario` reads as an equal scenario."""
    tree = scenario.model_dump(mode="json", exclude_none=True)
    require = tree.pop("require")
    tables = {key: tree.pop(key) for key in ("lamps", "beacons")}
    return tomlkit.dumps(tree | {key: items for key, items in tables.items() if items} | {"require": require})


def read_toml(file: Path) -> tuple[dict[str, Any], dict[str, int]]:
    """Reads one TOML file; a file that it extends is not read.

    Returns:
        Keys and values, and the line number of each dotted key.

    Raises:
        ScenarioError: the file cannot be read, or is not TOML.
    """
    try:
        text = file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise ScenarioError([f"{file}:1: cannot be read: {error}"]) from None
    try:
        tree = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        line = re.search(r"line (\d+)", str(error))
        number = line[1] if line else len(text.splitlines())
        raise ScenarioError([f"{file}:{number}: not TOML: {error}"]) from None
    return tree, key_lines(text)


def _read_with_base(file: Path, including_files: tuple[Path, ...]) -> tuple[dict[str, Any], Source, list[str]]:
    """Reads a file and merges it over its base file.

    Args:
        including_files: absolute paths of the files that extend this one, directly or indirectly.

    Returns:
        The merged keys and values, with absolute file paths and without old names of renamed keys; the files and line
        numbers that they come from; and one error for each old name.
    """
    if file.resolve() in including_files:
        raise ScenarioError([f"{file}:1: extends: the file extends itself (allowed: another file)"])
    tree, lines = read_toml(file)
    errors = [
        f"{file}:{lines[old]}: {old}: renamed to {new}" for old, new in _RENAMED_KEYS.items() if _remove(tree, old)
    ]
    _resolve_paths(tree, file.parent)
    base = tree.pop("extends", None)
    if base is None:
        return tree, Source(path=file, lines=lines), errors
    base_file = (file.parent / str(base)).resolve()
    if not base_file.is_file():
        raise ScenarioError([*errors, f"{file}:{lines.get('extends', 1)}: extends: no such file {str(base)!r}"])
    base_tree, base_source, base_errors = _read_with_base(base_file, (*including_files, file.resolve()))
    return _merge(base_tree, tree), Source(path=file, lines=lines, base=base_source), errors + base_errors


def _remove(tree: dict[str, Any], key: str) -> bool:
    """Removes a dotted key from the tree; returns whether it was there."""
    *sections, leaf = key.split(".")
    node: Any = tree
    for section in sections:
        node = node.get(section) if isinstance(node, dict) else None
    return isinstance(node, dict) and node.pop(leaf, _ABSENT) is not _ABSENT


def _resolve_paths(tree: dict[str, Any], folder: Path) -> None:
    """Makes the file paths in a tree absolute, in place; relative paths refer to `folder`."""
    for section, key in (name.split(".") for name in _PATH_KEYS):
        keys = tree.get(section)
        if isinstance(keys, dict) and isinstance(keys.get(key), str):
            keys[key] = str(_expand(keys[key], folder))


def _expand(value: str, folder: Path) -> Path:
    """Returns an absolute path with ${TWIN_DATA} expanded; a relative path without it refers to `folder`."""
    data = os.environ.get("TWIN_DATA", "../shared/data")
    if "${TWIN_DATA}" in value:
        return Path(value.replace("${TWIN_DATA}", data)).resolve()
    return (folder / value).resolve()


def _merge(base: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    """Returns two trees merged; where both contain a key, the value in `top` takes precedence."""
    result = dict(base)
    for key, value in top.items():
        nested = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = _merge(result[key], value) if nested else value
    return result


def _apply_override(tree: dict[str, Any], override: str) -> None:
    """Sets a key of the tree to a value, both given as `key=value`."""
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ScenarioError([f"--set {override}: not of the form key=value (for instance plan.tracks=2)"])
    if new_key := _renamed(key):
        raise ScenarioError([f"--set: {key}: renamed to {new_key}"])
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        value = text
    _assign(tree, key, str(_expand(str(value), Path.cwd())) if key in _PATH_KEYS else value, f"--set {override}")


def _assign(tree: dict[str, Any], key: str, value: Any, origin: str) -> None:
    """Sets a dotted key in the tree.

    Args:
        origin: source of the value, with which error messages begin.
    """
    *parents, leaf = key.split(".")
    if parents[:1] == ["require"]:
        parents, leaf = ["require"], ".".join([*parents[1:], leaf]).strip('"')
    node: Any = tree
    for part in parents:
        node = _child(node, part, origin)
        if not isinstance(node, dict | list):
            raise ScenarioError([f"{origin}: {part} is a value, not a section"])
    if isinstance(node, list):
        raise ScenarioError([f"{origin}: an item of the list must be named, as in {'.'.join(parents)}.0.{leaf}=..."])
    node[leaf] = value


def _child(node: Any, part: str, origin: str) -> Any:
    """Returns the section or list item `part` of a node; a missing section is created."""
    if not isinstance(node, list):
        return node.setdefault(part, {})
    if not part.isdigit() or int(part) >= len(node):
        raise ScenarioError([f"{origin}: no item {part} (allowed: 0 to {len(node) - 1})"])
    return node[int(part)]


def _renamed(key: str) -> str | None:
    """Returns the new name of a renamed key, or of a key in a renamed section; None for any other key."""
    for old, new in _RENAMED_KEYS.items():
        if key == old or key.startswith(f"{old}."):
            return new + key.removeprefix(old)
    return None


def _as_twin_error(item: Any, model: type[BaseModel]) -> TwinError:
    """Converts a pydantic error to a TwinError with dotted key, problem and allowed values."""
    field = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        allowed = _fields(item["loc"][:-1], model)
        return TwinError(field, f"unknown key{_hint(str(item['loc'][-1]), allowed)}", ", ".join(allowed))
    value = item.get("input")
    shown = "" if isinstance(value, dict) else f"{value!r}: "
    if item["type"] == "missing":
        return TwinError(field, "missing", "a value must be given")
    return TwinError(field, f"{shown}not allowed", _ALLOWED.get(item["type"]) or item["msg"].removeprefix(_PREFIX))


_PREFIX = "Input should be "
#: Allowed value for each type of pydantic error; for other types, pydantic's message is used.
_ALLOWED = {
    "model_type": "a section",
    "tuple_type": "a list",
    "dict_type": "a section",
    "string_type": "a string",
    "string_too_short": "a non-empty string",
    "int_type": "an integer",
    "int_parsing": "an integer",
    "int_from_float": "an integer",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
}


def _fields(location: Iterable[Any], model: Any) -> list[str]:
    """Returns the keys allowed in a section of the model, given the path to the section."""
    for part in location:
        if part not in model.model_fields:  # an item of a list, a key of a table
            continue
        annotation = model.model_fields[part].annotation
        arguments = getattr(annotation, "__args__", (annotation,))
        model = next(a for a in arguments if isinstance(a, type) and issubclass(a, BaseModel))
    return list(model.model_fields)


def _hint(word: str, names: Sequence[str]) -> str:
    """Returns ` (did you mean NAME?)` with the name most similar to the word, or "" if none is similar."""
    close = difflib.get_close_matches(word, names, n=1)
    return f" (did you mean {close[0]}?)" if close else ""
