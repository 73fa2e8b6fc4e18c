"""The package `jerlov`: published optical data of sea water and light with provenance."""

from __future__ import annotations

import importlib
from typing import Any

from twin.errors import TwinError


def jerlov_package() -> Any:
    """Returns the package `jerlov`, imported at the first call, because clear water does not need it.

    Raises:
        TwinError: the package is not installed.
    """
    try:
        return importlib.import_module("jerlov")
    except ModuleNotFoundError:
        raise TwinError("water.source", "the package jerlov is not installed", "pip install jerlov") from None
