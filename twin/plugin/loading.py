"""Loading of plug-ins: classes of other packages, named `module:Class` or registered as entry points."""

from __future__ import annotations

import difflib
import importlib
from collections.abc import Callable
from importlib.metadata import entry_points
from operator import attrgetter
from typing import Any, NamedTuple, TypeVar

from twin.errors import TwinError, described

#: Groups of entry points under which other packages register plug-ins.
CONTROLLERS, ESTIMATORS, TERRAINS, READERS = "twin.controllers", "twin.estimators", "twin.terrains", "twin.readers"

T = TypeVar("T")


class Registered(NamedTuple):
    """A plug-in that another package registers."""

    name: str  # name of the entry point
    target: str  # module and class as the entry point gives them, for example "mypackage.control:LQR"
    create: Callable[..., Any]  # the class; calling it returns the plug-in


def registered(group: str) -> list[Registered]:
    """Imports and returns the plug-ins that the installed packages register in a group of entry points.

    Raises:
        TwinError: a plug-in cannot be imported; the message names the group, the entry point and the cause.
    """
    return [
        Registered(entry.name, entry.value, attempt(f"{group} {entry.name}", entry.value, entry.load))
        for entry in entry_points(group=group)
    ]


def load(key: str, group: str, name: str) -> Callable[..., Any]:
    """Returns the class that a name refers to; loading imports its module, which runs code of its package.

    Args:
        key: key of the scenario that gives the name, for error messages.
        group: group of entry points in which a name without a colon is looked up.
        name: "module:Class", where the module can be imported, or the name of an entry point.

    Raises:
        TwinError: there is no such entry point, the module cannot be imported, or it has no such class.
    """
    module, colon, attribute = name.partition(":")
    if colon:
        return attempt(key, name, lambda: _attribute(importlib.import_module(module), attribute))
    entries = {entry.name: entry for entry in entry_points(group=group)}
    if name not in entries:
        close = difflib.get_close_matches(name, entries, n=1)
        hint = f" (did you mean {close[0]}?)" if close else ""
        allowed = ", ".join(["module:Class", *sorted(entries)])
        raise TwinError(key, f"{name}: no installed package registers this name in {group}{hint}", allowed)
    return attempt(key, name, entries[name].load)


def attempt(key: str, name: str, function: Callable[[], T]) -> T:
    """Returns the result of a function that runs code of a plug-in; raises TwinError if it raises any exception."""
    try:
        return function()
    except (Exception, SystemExit) as error:  # a plug-in may raise any exception
        raise TwinError(key, f"{name}: {described(error)}", "a plug-in that can be loaded") from None


def _attribute(module: Any, dotted: str) -> Callable[..., Any]:
    """Returns the class with a dotted name in a module. Raises AttributeError or TypeError if the module has none."""
    found = attrgetter(dotted)(module)
    if not callable(found):
        raise TypeError(f"{dotted} is not a class")
    return found
