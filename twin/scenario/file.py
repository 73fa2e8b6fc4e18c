"""Reading, validation and writing of scenarios as TOML files, with base files and overrides."""

import copy
import os
import re
import tomllib
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

import tomlkit
from pydantic import BaseModel, ValidationError

from twin.core.user_files import is_file, read_text, resolved
from twin.errors import ScenarioError, TwinError, did_you_mean
from twin.scenario import toml_text
from twin.scenario.model import Scenario, Source
from twin.scenario.model_files import KINDS, built_in

Model = TypeVar("Model", bound=BaseModel)
Describe = Callable[[TwinError], str]
#: Keys whose value is the path of a file, without the numbers of list items.
_PATH_KEYS = (
    "imaging.error_model", "objects.mesh_file", "plan.polygon", "terrain.height_file", "terrain.mesh_file",
    "terrain.orthophoto_file", "terrain.prior_file", "terrain.texture_file", "water.spectrum_file", "current.file",
)  # fmt: skip
#: Old keys of the scenario and their new names.
_RENAMED_KEYS = {
    "calibration": "calibration_error",
    "imaging.calibration": "imaging.error_model",
    "imaging.forward_scatter": "imaging.scattering",
}
#: Sections with a key `plugin`, and the group of its entry points.
_PLUGIN_SECTIONS = {"control": "controllers", "estimate": "estimators", "terrain": "terrains"}
_IN_PYTHON = "in Python: allow_plugins=True"
_MODELS = tuple(kind.key for kind in KINDS)
#: Keys of [terrain] that say which floor it is.
_FLOOR_KEYS = ("kind", "plugin", "height_file", "mesh_file")
#: Largest number of errors that are listed.
_MAX_ERRORS = 20


def load_scenario(path: str | Path, overrides: Sequence[str] = (), allow_plugins: bool = False) -> Scenario:
    """Returns the validated scenario of a file, merged over the files that it extends, with overrides applied.

    Arguments and errors are those of `twin.load_scenario`; overrides are strings `key=value` with a dotted key and a
    TOML value, and other values are taken as strings.
    """
    tree, source, errors = _read_with_base(find_scene(path))
    base = copy.deepcopy(tree)
    source = source.model_copy(update={"overrides": tuple(overrides), "allow_plugins": allow_plugins})
    for override in sorted(overrides, key=lambda one: one.partition("=")[0].strip() not in _MODELS):
        try:
            _apply_override(tree, override)
        except ScenarioError as error:
            errors += error.lines
    try:
        scenario = _on_its_floor(tree, base, source)
    except ScenarioError as error:
        raise ScenarioError([*errors, *error.lines]) from None
    if errors:
        raise ScenarioError(errors)
    return scenario


def read_tree(path: str | Path) -> dict[str, Any]:
    """Returns the keys and values of a scenario, merged over those of its base file; the values are not validated.

    Raises ScenarioError if there is no such scenario, or a file is invalid (`read_toml`), extends itself or an unknown
    file, or contains the old name of a renamed key.
    """
    tree, _, errors = _read_with_base(find_scene(path))
    if errors:
        raise ScenarioError(errors)
    return tree


def with_values(tree: Mapping[str, Any], values: Mapping[str, Any], source: Source) -> Scenario:
    """Sets dotted keys of a scenario to new values and returns the validated scenario; `tree` is not modified.

    Relative file paths refer to the folder of `source.path`, the file that the values come from, for messages. An empty
    path leaves its key as it is in `tree`, so that a table can set a file in some of its rows only. Raises
    ScenarioError if a key is renamed or cannot be set, or the scenario is invalid.
    """
    changed = copy.deepcopy(dict(tree))
    for key, value in sorted(values.items(), key=lambda item: item[0] not in _MODELS):
        if new_key := _renamed(key):
            raise ScenarioError([source.describe(TwinError(key, f"renamed to {new_key}"))])
        if value == "" and _is_path_key(key):
            continue
        try:
            _assign(changed, key, _absolute(key, value, source.path.parent), key)
            _take_models(changed, changed, source.path.parent, str)
        except ScenarioError as error:
            problem = error.lines[0].removeprefix(f"{key}: ")
            raise ScenarioError([source.describe(TwinError(key, problem))]) from None
    return _on_its_floor(changed, tree, source)


def validated(tree: Mapping[str, Any], model: type[Model], source: Source) -> Model:
    """Returns the model of a tree of keys and values.

    Raises ScenarioError if a key or a value is invalid, or a plug-in is named as module:Class and the source does not
    allow it; lists up to `_MAX_ERRORS` errors and the number of the others.
    """
    if refused := [] if source.allow_plugins else [source.describe(error) for error in _plugin_errors(tree)]:
        raise ScenarioError(refused)
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        items = error.errors(include_url=False)
        lines = [source.describe(_as_twin_error(item, model)) for item in items[:_MAX_ERRORS]]
        more = [f"... and {len(items) - _MAX_ERRORS} more"] if len(items) > _MAX_ERRORS else []
        raise ScenarioError(lines + more) from None


def _on_its_floor(tree: dict[str, Any], base: Mapping[str, Any], source: Source) -> Scenario:
    _leave_objects_on_their_floor(tree, base)
    scenario = validated(tree, Scenario, source)
    scenario._source = source
    return scenario


def _plugin_errors(tree: Mapping[str, Any]) -> Iterator[TwinError]:
    for section, kind in _PLUGIN_SECTIONS.items():
        keys = tree.get(section)
        name = keys.get("plugin") if isinstance(keys, dict) else None
        if isinstance(name, str) and ":" in name:
            yield plugin_error(f"{section}.plugin", name, kind)


def plugin_error(key: str, name: str, kind: str) -> TwinError:
    problem = f"{shown(repr(name))} runs code of any module"
    return TwinError(key, problem, f"an installed entry point of twin.{kind}; any with --allow-plugins ({_IN_PYTHON})")


def find_scene(path: str | Path) -> Path:
    """Returns the path of a file, or of the scenario of this name in scenes/, with or without "scenes/" and ".toml".

    Raises ScenarioError if there is neither a file nor a scenario of this name.
    """
    candidate = Path(path)
    if is_file(candidate):
        return candidate
    files = built_in()
    name = str(path).removesuffix(".toml").removeprefix("scenes/")
    if name in files:
        return files[name]
    hint, allowed = did_you_mean(str(path), list(files)), f"a file, or one of {', '.join(files)}"
    raise ScenarioError([f"{shown(str(path))}: no such scenario{hint} (allowed: {allowed})"])


def dump_toml(scenario: Scenario) -> str:
    """Returns the scenario as the text of a TOML file, from which `load_scenario` reads the same values."""
    tree = scenario.model_dump(mode="json", exclude_none=True)
    require = tree.pop("require")
    tables = {key: tree.pop(key) for key in ("lamps", "beacons", "objects")}
    return tomlkit.dumps(tree | {key: items for key, items in tables.items() if items} | {"require": require})


def input_files(scenario: Scenario) -> list[Path]:
    """Returns the files that the keys of a scenario name."""

    def named(key: str, value: Any) -> Iterator[Path]:
        if isinstance(value, dict):
            for name, item in value.items():
                yield from named(f"{key}.{name}" if key else name, item)
        elif isinstance(value, list):
            for item in value:
                yield from named(key, item)
        elif isinstance(value, str) and _is_path_key(key):
            yield Path(value)

    return list(named("", scenario.model_dump(mode="json", exclude_none=True)))


@lru_cache(maxsize=16)  # the surveys of a study read the same files
def _parsed(text: str) -> tuple[dict[str, Any], dict[str, int]]:
    return toml_text.parse_toml(text), toml_text.key_lines(text)


def read_toml(file: Path) -> tuple[dict[str, Any], dict[str, int]]:
    """Returns the keys and values of one TOML file, and the line number of each dotted key (`key_lines`).

    Raises ScenarioError if the file cannot be read, is not TOML, or exceeds the limits of `toml_text`.
    """
    try:
        text = read_text(file, most_bytes=4 * toml_text.MAX_CHARACTERS, encoding="utf-8-sig")
    except TwinError as error:
        raise ScenarioError([f"{file}:1: {error.problem}"]) from None
    try:
        tree, lines = copy.deepcopy(_parsed(text))
    except ValueError as error:
        line = re.search(r"line (\d+)", str(error))
        number = line[1] if line else min(len(text.splitlines()), text.count("\n") + 1)
        raise ScenarioError([f"{file}:{number}: not TOML: {error}"]) from None
    source = Source(path=file, lines=lines)
    if errors := [source.describe(error) for error in islice(toml_text.value_errors(tree), _MAX_ERRORS)]:
        raise ScenarioError(errors)
    return tree, lines


def _read_with_base(file: Path, including: tuple[Path, ...] = ()) -> tuple[dict[str, Any], Source, list[str]]:
    """Reads a file and merges it over its base file; `including` are the absolute paths of the files that extend it.

    Returns the merged keys and values, with absolute file paths and without old names of renamed keys; the files and
    line numbers that they come from; and one error for each old name. Raises ScenarioError if the file extends itself,
    its base file does not exist, or a file is invalid (`read_toml`).
    """
    if resolved(file) in including:
        raise ScenarioError([f"{file}:1: extends: the file extends itself (allowed: another file)"])
    tree, lines = read_toml(file)
    source = Source(path=file, lines=lines)
    renamed = [TwinError(old, f"renamed to {new}") for old, new in _RENAMED_KEYS.items() if _remove(tree, old)]
    errors = [source.describe(error) for error in renamed]
    tree = _absolute("", tree, file.parent)
    base = tree.pop("extends", None)
    if base is None:
        return _merged(tree, {}, source), source, errors
    base_file = resolved(file.parent / str(base))
    if not is_file(base_file) and (base_file := built_in().get(str(base))) is None:
        allowed = f"a path relative to this file, or one of {', '.join(built_in())}"
        message = f"no such file {shown(repr(str(base)))} (allowed: {allowed})"
        raise ScenarioError([*errors, f"{file}:{lines.get('extends', 1)}: extends: {message}"])
    base_tree, base_source, base_errors = _read_with_base(base_file, (*including, resolved(file)))
    merged = _merged(tree, base_tree, source)
    _leave_objects_on_their_floor(merged, base_tree)
    return merged, source.model_copy(update={"base": base_source}), errors + base_errors


def _merged(tree: dict[str, Any], base: dict[str, Any], source: Source) -> dict[str, Any]:
    """Returns the keys of a file merged over those of its base file, and of the rig and vehicle that it names."""
    _take_models(tree, base, source.path.parent, source.describe)
    return _merge(base, tree)


def _take_models(tree: dict[str, Any], base: dict[str, Any], folder: Path, describe: Describe) -> None:
    """Removes the models (`KINDS`) from a tree; replaces the sections of `base` by those of the files they name.

    Raises ScenarioError if there is no such rig or vehicle, as `describe` words it, or if its file is invalid.
    """
    for kind in KINDS:
        section = tree.get(kind.name)
        if not isinstance(section, dict) or not isinstance(section.get("model"), str):
            continue  # what is no text is refused by the validation
        try:
            file = kind.find(section.pop("model"), folder)
        except TwinError as error:
            raise ScenarioError([describe(error)]) from None
        sections, lines = read_toml(file)
        validated(sections, kind.contents, Source(path=file, lines=lines))
        for key in kind.replaced:
            base.pop(key, None)
        base |= {key: sections[key] for key in (*kind.replaced, *kind.optional) if key in sections}
        base[kind.name] = {**sections[kind.name], "title": sections["title"]}


def _leave_objects_on_their_floor(tree: dict[str, Any], base: Mapping[str, Any]) -> None:
    """Removes objects that a tree has from its base, in place, if its floor is another: that is where they lie."""
    floors = [terrain if isinstance(terrain := one.get("terrain"), dict) else {} for one in (tree, base)]
    other_floor = any(floors[0].get(key) != floors[1].get(key) for key in _FLOOR_KEYS)
    if other_floor and tree.get("objects") == base.get("objects"):
        tree.pop("objects", None)


def _remove(tree: dict[str, Any], key: str) -> bool:
    section, _, leaf = key.rpartition(".")
    node = tree.get(section) if section else tree
    return isinstance(node, dict) and node.pop(leaf, tree) is not tree


def _is_path_key(key: str) -> bool:
    return re.sub(r"\.\d+\b", "", key) in _PATH_KEYS


def _absolute(key: str, value: Any, folder: Path) -> Any:
    if isinstance(value, dict):
        return {name: _absolute(f"{key}.{name}" if key else name, item, folder) for name, item in value.items()}
    if isinstance(value, list):
        return [_absolute(key, item, folder) if isinstance(item, dict) else item for item in value]
    if not isinstance(value, str) or not _is_path_key(key):
        return value
    data = os.environ.get("TWIN_DATA", "../shared/data")  # which may refer to the current folder
    in_data = Path(value.replace("${TWIN_DATA}", data))
    return str(resolved(in_data if "${TWIN_DATA}" in value else folder / value))


def _merge(base: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in top.items():
        nested = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = _merge(result[key], value) if nested else value
    return result


def _apply_override(tree: dict[str, Any], override: str) -> None:
    key, equals, text = override.partition("=")
    key = key.strip()
    if not equals or not key:
        raise ScenarioError([f"--set {shown(override)}: not of the form key=value (for instance plan.tracks=2)"])
    if len(key) > toml_text.MAX_KEY_CHARACTERS or key.count(".") >= toml_text.MAX_LEVELS:
        allowed = f"up to {toml_text.MAX_KEY_CHARACTERS} characters and {toml_text.MAX_LEVELS} levels"
        raise ScenarioError([f"--set {shown(override)}: not a key (allowed: {allowed})"])
    if new_key := _renamed(key):
        raise ScenarioError([f"--set: {key}: renamed to {new_key}"])
    value = _override_value(key, text)
    value = value if isinstance(value, list | str) or not _is_path_key(key) else text.strip()
    _assign(tree, key, _absolute(key, value, Path.cwd()), f"--set {shown(override)}")
    _take_models(tree, tree, Path.cwd(), lambda error: f"--set: {error}")


def _override_value(key: str, text: str) -> Any:
    """Returns the TOML value in the text of an override, within limits; the text itself if it is not a single value."""
    try:
        given = toml_text.parse_toml(f"v = {text}")
    except tomllib.TOMLDecodeError:
        return text
    except ValueError as error:
        raise ScenarioError([f"--set: {TwinError(key, str(error))}"]) from None
    if given.keys() != {"v"}:  # the text has further lines with keys of their own
        return text
    for error in toml_text.value_errors({key: given["v"]}):
        raise ScenarioError([f"--set: {error}"])
    return given["v"]


def _assign(tree: dict[str, Any], key: str, value: Any, origin: str) -> None:
    """Sets a dotted key in the tree; raises ScenarioError, whose message begins with `origin`, if there is no place.

    All parts of the key but the last one must be sections, or existing items of a list.
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
        name, whole = ".".join(parents), leaf.isdecimal()
        problem = "an item cannot be replaced" if whole else "an item of the list must be named"
        allowed = f" (allowed: a key of an item, or {name}=[...])" if whole else f", as in {name}.0.{leaf}=..."
        raise ScenarioError([f"{origin}: {problem}{allowed}"])
    node[leaf] = value


def _child(node: Any, part: str, origin: str) -> Any:
    if not isinstance(node, list):
        return node.setdefault(part, {})
    if not part.isdecimal() or int(part) >= len(node):
        allowed = f"0 to {len(node) - 1}" if node else "none, as the list is empty"
        raise ScenarioError([f"{origin}: no item {part} (allowed: {allowed})"])
    return node[int(part)]


def _renamed(key: str) -> str | None:
    for old, new in _RENAMED_KEYS.items():
        if key == old or key.startswith(f"{old}."):
            return new + key.removeprefix(old)
    return None


def _as_twin_error(item: Any, model: type[BaseModel]) -> TwinError:
    parts = (str(part) for part in item["loc"])  # with those of pydantic for the alternatives of a value
    field = ".".join(part for part in parts if not part.startswith(("literal[", "constrained-")))
    if item["type"] == "extra_forbidden":
        allowed = _fields(item["loc"][:-1], model)
        return TwinError(field, f"unknown key{did_you_mean(str(item['loc'][-1]), allowed)}", ", ".join(allowed))
    value = item.get("input")
    text = "" if isinstance(value, dict) else f"{shown(repr(value))}: "
    if item["type"] == "missing":
        return TwinError(field, "missing", "a value must be given")
    return TwinError(field, f"{text}not allowed", _ALLOWED.get(item["type"]) or item["msg"].removeprefix(_PREFIX))


_PREFIX = "Input should be "
#: Allowed value for each type of pydantic error; for other types, pydantic's message is used.
_ALLOWED = {
    **dict.fromkeys(("model_type", "dict_type"), "a section"),
    "tuple_type": "a list",
    "string_type": "a string",
    "string_too_short": "a non-empty string",
    "string_pattern_mismatch": "module:Class, or the name of an entry point",
    **dict.fromkeys(("int_type", "int_parsing", "int_from_float"), "an integer"),
    **dict.fromkeys(("float_type", "float_parsing"), "a number"),
    **dict.fromkeys(("bool_type", "bool_parsing"), "true or false"),
}


def shown(text: str) -> str:
    """Returns the text for an error message; of more than 200 characters, the first 100."""
    return text if len(text) <= 200 else f"{text[:100]}... ({len(text)} characters)"


def _fields(location: Iterable[Any], model: Any) -> list[str]:
    for part in location:
        if part not in model.model_fields:  # an item of a list, a key of a table
            continue
        annotation = model.model_fields[part].annotation
        arguments = getattr(annotation, "__args__", (annotation,))
        model = next(a for a in arguments if isinstance(a, type) and issubclass(a, BaseModel))
    return list(model.model_fields)
