"""Checks of this machine (Python, packages, disk space, processors, OpenGL), with a remedy for each failure."""

import os
import platform
import shutil
import sys
import tempfile
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

_PACKAGES = ("mujoco", "numpy", "scipy", "opencv-python-headless", "numba", "rasterio", "rerun-sdk")
_ENOUGH_DISK_GB = 2.0
_DRAWING_LIMIT_S = 60.0
INSTALL_LINE = "apt-get install -y libegl1 libgl1 libgl1-mesa-dri"


class Check(NamedTuple):
    name: str
    ok: bool
    found: str  #: version, size or error message
    remedy: str = ""  #: command or action that fixes a failure
    optional: bool = False  #: whether surveys run without it

    def __str__(self) -> str:
        failed = "missing" if self.optional else "FAILED"
        line = f"{'ok' if self.ok else failed:<8} {self.name}: {self.found}"
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
        check_opengl(),
    ]


def check_opengl() -> Check:
    """Returns whether the picture of the surface in reports can be drawn; nothing else needs OpenGL."""
    import trimesh

    from twin.report.mesh_picture import surface_picture

    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / "mesh.glb"
        trimesh.creation.icosphere(vertex_colors=(200, 200, 200)).export(mesh)
        drawn = surface_picture(mesh, limit_s=_DRAWING_LIMIT_S) is not None
    found = (
        "draws the surface in reports" if drawn else "reports have no picture of the surface; surveys do not need it"
    )
    return Check("OpenGL", drawn, found, INSTALL_LINE if os.geteuid() == 0 else f"sudo {INSTALL_LINE}", optional=True)


def _package(name: str) -> Check:
    try:
        return Check(name, True, version(name))
    except PackageNotFoundError:
        return Check(name, False, "not installed", f"{sys.executable} -m pip install {name}")
