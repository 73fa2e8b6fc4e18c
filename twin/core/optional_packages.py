"""Import of packages that belong to an optional extra of this project."""

from importlib import import_module
from typing import Any

from twin.errors import TwinError


def optional(module: str, extra: str, purpose: str) -> Any:
    """Returns a module of the optional packages `extra`; TwinError, which names `purpose`, if it is not installed."""
    try:
        return import_module(module)
    except ModuleNotFoundError as error:
        package = module.partition(".")[0]
        if (error.name or "").partition(".")[0] != package:
            raise
        problem = f"needs the package {package}, which is not installed"
        raise TwinError(purpose, problem, f"pip install 'seabed-twin[{extra}]'") from None
