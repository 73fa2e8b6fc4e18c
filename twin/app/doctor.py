"""Checks of this machine (Python, packages, disk space, processors), with a remedy for each failure."""

import os
import platform
import shutil
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

_PACKAGES = ("mujoco", "numpy", "scipy", "opencv-python-headless", "numba", "rasterio", "rerun-sdk")
_ENOUGH_DISK_GB = 2.0


class Check(NamedTuple):
    name: str
    ok: bool
    found: str  #: version, size or error message
    remedy: str = ""  #: command or action that fixes a failure

    def __str__(self) -> str:
        line = f"{'ok' if self.ok else 'FAILED':<8} {self.name}: {self.found}"
        return line if self.ok else f"{line}\n{'':<8} to fix it: {self.remedy}"


def check_machine(folder: Path) -> list[Check]:
    """Returns the results of all checks; `folder` is the one below which runs are written."""
    free_gb = shutil.disk_usage(folder).free / 1e9
    remedy = f"free {_ENOUGH_DISK_GB:g} GB, or choose another disk with --out"
    return [
        Check("Python", sys.version_info >= (3, 11), platform.python_version(), "install Python 3.11 or newer"),
        *(_package(name) for name in _PACKAGES),
        Check("disk", free_gb >= _ENOUGH_DISK_GB, f"{free_gb:.1f} GB free", remedy),
        Check("processors", True, f"{os.cpu_count()} ({platform.machine()})"),
    ]


def _package(name: str) -> Check:
    try:
        return Check(name, True, version(name))
    except PackageNotFoundError:
        return Check(name, False, "not installed", f"{sys.executable} -m pip install {name}")
