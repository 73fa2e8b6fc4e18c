"""The scenario as a TOML file: read with what it extends and overrides, all faults told at once; and written."""

from __future__ import annotations

import copy
import difflib
import os
import re
import tomllib
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, TypeVar

from pydantic import BaseModel, ValidationError

from twin.errors import ScenarioError, TwinError
from twin.scenario.model import Scenario, Source

Model = TypeVar("Model", bound=BaseModel)
_PATH_KEYS = ("imaging.error_model", "terrain.height_file", "terrain.texture_file", "water.spectrum_file")


def load_scenario(path: str | Path, overrides: Sequence[str] = ()) -> Scenario:
    """Reads a scenario file (or a name in scenes/), with what it extends and `key=value` overrides.

    Raises:
        ScenarioError: every fault of the file, each as `FILE:LINE: key: what is wrong`.
    """
    file = find_scene(path)
    tree, lines = _read(file, seen=())
    source = Source(path=file, lines=lines, overrides=tuple(overrides))
    for override in overrides:
        _apply(tree, override)
    scenario = validated(tree, Scenario, source)
    scenario._source = source
    return scenario


def read_tree(path: str | Path) -> dict[str, Any]:
    """The keys and values of a scenario file (or a name in scenes/) with what it extends, unchecked."""
    return _read(find_scene(path), seen=())[0]


def with_values(tree: Mapping[str, Any], values: Mapping[str, Any], source: Source) -> Scenario:
    """The scenario of a tree with the values of these dotted keys in place of its own.

    Args:
        source: tells where a fault is; paths among the values are relative to its file.

    Raises:
        ScenarioError: every fault of the outcome.
    """
    changed = copy.deepcopy(dict(tree))
    for key, value in values.items():
        is_path = key in _PATH_KEYS and isinstance(value, str)
        try:
            _assign(changed, key, str(_expand(value, source.path.parent)) if is_path else value, key)
        except ScenarioError as error:
            fault = TwinError(key, error.lines[0].removeprefix(f"{key}: "))
            raise ScenarioError([source.fault(fault)]) from None
    scenario = validated(changed, Scenario, source)
    scenario._source = source
    return scenario


def validated(tree: Mapping[str, Any], model: type[Model], source: Source) -> Model:
    """The tree as a model of the house. Raises ScenarioError with every fault."""
    try:
        return model.model_validate(tree)
    except ValidationError as error:
        raise ScenarioError([source.fault(_explain(item, model)) for item in error.errors()]) from None


def find_scene(path: str | Path) -> Path:
    """The file of a scenario: a path that exists, or the name of one in scenes/."""
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
    """The scenario as TOML that `load_scenario` reads back to an equal one."""
    tree = scenario.model_dump(mode="json", exclude_none=True)
    lists, require = {key: tree.pop(key) for key in ("lamps", "beacons")}, tree.pop("require")
    out = [f"{k} = {_toml(v)}" for k, v in tree.items() if not isinstance(v, dict)]
    sections = [(f"[{k}]", v) for k, v in tree.items() if isinstance(v, dict)]
    sections += [(f"[[{key}]]", item) for key, items in lists.items() for item in items] + [("[require]", require)]
    for head, body in sections:
        out += ["", head, *(f"{_toml_key(k)} = {_toml(v)}" for k, v in body.items())]
    return "\n".join(out) + "\n"


def _toml_key(key: str) -> str:
    return key if re.fullmatch(r"[A-Za-z0-9_-]+", key) else f'"{key}"'


def _toml(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return '"' + value.replace("\\", "\\\\").replace('"', '\\"') + '"'
    if isinstance(value, list | tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(value)


def _read(file: Path, seen: tuple[Path, ...]) -> tuple[dict[str, Any], dict[str, int]]:
    """One TOML file merged over what it extends, its file paths made absolute, with the line of each key."""
    if file.resolve() in seen:
        raise ScenarioError([f"{file}:1: extends: the file extends itself (allowed: another file)"])
    tree, lines = read_toml(file)
    _resolve_paths(tree, file.parent)
    base = tree.pop("extends", None)
    if base is None:
        return tree, lines
    base_file = (file.parent / str(base)).resolve()
    if not base_file.is_file():
        raise ScenarioError([f"{file}:{lines.get('extends', 1)}: extends: no such file {str(base)!r}"])
    base_tree, _ = _read(base_file, (*seen, file.resolve()))
    return _merge(base_tree, tree), lines


def read_toml(file: Path) -> tuple[dict[str, Any], dict[str, int]]:
    """A TOML file as it stands, with the line of each key.

    Raises:
        ScenarioError: it cannot be read, or is no TOML.
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
    return tree, _key_lines(text)


def _resolve_paths(tree: dict[str, Any], folder: Path) -> None:
    for section, key in (name.split(".") for name in _PATH_KEYS):
        keys = tree.get(section)
        if isinstance(keys, dict) and isinstance(keys.get(key), str):
            keys[key] = str(_expand(keys[key], folder))


def _expand(value: str, folder: Path) -> Path:
    """A path with ${TWIN_DATA} expanded; relative paths are relative to the scenario's folder."""
    data = os.environ.get("TWIN_DATA", "../shared/data")
    if "${TWIN_DATA}" in value:
        return Path(value.replace("${TWIN_DATA}", data)).resolve()
    return (folder / value).resolve()


def _merge(base: dict[str, Any], top: dict[str, Any]) -> dict[str, Any]:
    result = dict(base)
    for key, value in top.items():
        nested = isinstance(value, dict) and isinstance(result.get(key), dict)
        result[key] = _merge(result[key], value) if nested else value
    return result


def _key_lines(text: str) -> dict[str, int]:
    """Line number of every dotted key of a TOML text; of array tables the items count from 0."""
    lines: dict[str, int] = {}
    counts: dict[str, int] = {}
    prefix = ""
    for number, line in enumerate(text.splitlines(), 1):
        if array := re.match(r"\s*\[\[\s*([\w.]+)\s*\]\]", line):
            counts[array[1]] = counts.get(array[1], -1) + 1
            prefix = f"{array[1]}.{counts[array[1]]}"
            lines.setdefault(array[1], number)
            lines[prefix] = number
        elif table := re.match(r"\s*\[\s*([\w.]+)\s*\]", line):
            prefix = table[1]
            lines[prefix] = number
        elif key := re.match(r"""\s*(?:"([^"]+)"|'([^']+)'|([\w.-]+))\s*=""", line):
            name = key[1] or key[2] or key[3]
            lines[f"{prefix}.{name}" if prefix else name] = number
    return lines


def _apply(tree: dict[str, Any], override: str) -> None:
    """Sets one `a.b=value` in the tree; the value is read as TOML, else as text."""
    key, equals, text = override.partition("=")
    if not equals or not key.strip():
        raise ScenarioError([f"--set {override}: not of the form key=value (for instance plan.tracks=2)"])
    try:
        value = tomllib.loads(f"v = {text}")["v"]
    except tomllib.TOMLDecodeError:
        value = text
    key = key.strip()
    _assign(tree, key, str(_expand(str(value), Path.cwd())) if key in _PATH_KEYS else value, f"--set {override}")


def _assign(tree: dict[str, Any], key: str, value: Any, said: str) -> None:
    """Sets the dotted key in the tree; a fault begins with what was `said`."""
    *parents, leaf = key.split(".")
    if parents[:1] == ["require"]:
        parents, leaf = ["require"], ".".join([*parents[1:], leaf]).strip('"')
    node: Any = tree
    for part in parents:
        node = _enter(node, part, said)
        if not isinstance(node, dict | list):
            raise ScenarioError([f"{said}: {part} is a value, not a section"])
    if isinstance(node, list):
        raise ScenarioError([f"{said}: name one of the list, as in {'.'.join(parents)}.0.{leaf}=..."])
    node[leaf] = value


def _enter(node: Any, part: str, said: str) -> Any:
    """The section or list item of this name."""
    if not isinstance(node, list):
        return node.setdefault(part, {})
    if not part.isdigit() or int(part) >= len(node):
        raise ScenarioError([f"{said}: no item {part} (allowed: 0 to {len(node) - 1})"])
    return node[int(part)]


def _explain(item: Any, model: type[BaseModel]) -> TwinError:
    """One pydantic error in the words of the house."""
    where = ".".join(str(part) for part in item["loc"])
    if item["type"] == "extra_forbidden":
        allowed = _fields(item["loc"][:-1], model)
        return TwinError(where, f"unknown key{_hint(str(item['loc'][-1]), allowed)}", ", ".join(allowed))
    value = item.get("input")
    shown = "" if isinstance(value, dict) else f"{value!r}: "
    if item["type"] == "missing":
        return TwinError(where, "missing", "a value must be given")
    return TwinError(where, f"{shown}not allowed", _ALLOWED.get(item["type"]) or item["msg"].removeprefix(_PREFIX))


_PREFIX = "Input should be "
#: What pydantic says in words of its own, in the words of a scenario.
_ALLOWED = {
    "model_type": "a section",
    "tuple_type": "a list",
    "dict_type": "a section",
    "string_type": "a text",
    "string_too_short": "a text that is not empty",
    "int_type": "a whole number",
    "int_parsing": "a whole number",
    "int_from_float": "a whole number",
    "float_type": "a number",
    "float_parsing": "a number",
    "bool_type": "true or false",
    "bool_parsing": "true or false",
}


def _fields(location: Iterable[Any], model: Any) -> list[str]:
    """Names of the keys allowed in the section at this place of the model."""
    for part in location:
        if part not in model.model_fields:  # an item of a list, a key of a table
            continue
        annotation = model.model_fields[part].annotation
        arguments = getattr(annotation, "__args__", (annotation,))
        model = next(a for a in arguments if isinstance(a, type) and issubclass(a, BaseModel))
    return list(model.model_fields)


def _hint(word: str, names: Sequence[str]) -> str:
    close = difflib.get_close_matches(word, names, n=1)
    return f" (did you mean {close[0]}?)" if close else ""
