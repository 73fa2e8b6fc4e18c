"""Loading of plug-ins: classes of other packages, named `module:Class` or registered as entry points."""

import importlib
import sys
from collections.abc import Callable
from functools import partial
from importlib.metadata import EntryPoint, entry_points
from operator import attrgetter
from pathlib import Path
from typing import Any, TypeVar

from twin.errors import TwinError, described, did_you_mean

#: Groups of entry points under which other packages register plug-ins.
CONTROLLERS, ESTIMATORS, TERRAINS, READERS = "twin.controllers", "twin.estimators", "twin.terrains", "twin.readers"

T = TypeVar("T")


def registered(group: str, make: Callable[[Any, str], T]) -> list[T]:
    """Returns `make(plugin, "module:Class")` of the plug-ins of a group; raises TwinError, naming one that fails."""

    def made(entry: EntryPoint) -> T:
        return make(entry.load()(), entry.value)

    entries = entry_points(group=group)
    return [attempt(f"{group} {entry.name}", entry.value, partial(made, entry)) for entry in entries]


def load(key: str, group: str, name: str) -> Callable[..., Any]:
    """Returns the class "module:Class" or of an entry point; runs its package; raises TwinError, which names `key`."""
    module, colon, attribute = name.partition(":")
    if colon:
        return attempt(key, name, lambda: _attribute(importlib.import_module(module), attribute))
    entries = {entry.name: entry for entry in entry_points(group=group)}
    if name not in entries:
        problem = f"{name}: no installed package registers this name in {group}{did_you_mean(name, entries)}"
        raise TwinError(key, problem, ", ".join(["module:Class", *sorted(entries)]))
    return attempt(key, name, entries[name].load)


def source_files(key: str, group: str, name: str | None) -> list[Path]:
    """Returns all files of the package of a plug-in; none without `name`. Raises TwinError if it cannot be loaded."""
    if name is None:
        return []
    module = load(key, group, name).__module__
    files = [getattr(sys.modules.get(one), "__file__", None) for one in (module.partition(".")[0], module)]
    file = Path(next(filter(None, files), ""))
    found = file.parent.rglob("*") if file.name == "__init__.py" else [file]
    return [one for one in found if one.is_file() and "__pycache__" not in one.parts]


def attempt(key: str, name: str, function: Callable[[], T]) -> T:
    """Returns the result of a function that runs code of a plug-in; raises TwinError if it raises any exception."""
    try:
        return function()
    except (Exception, SystemExit) as error:  # a plug-in may raise any exception
        raise TwinError(key, f"{name}: {described(error)}", "a plug-in that can be loaded") from None


def _attribute(module: Any, dotted: str) -> Callable[..., Any]:
    found = attrgetter(dotted)(module)
    if not callable(found):
        raise TypeError(f"{dotted} is not a class")
    return found
