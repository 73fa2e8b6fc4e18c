"""What this machine brings, and what it lacks, each with the line that mends it.

Run as a program it is the probe: it draws one frame, in a process of its own, as a broken driver can take it down.
"""

from __future__ import annotations

import os
import platform
import shutil
import subprocess
import sys
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import NamedTuple

_PACKAGES = ("mujoco", "numpy", "scipy", "opencv-python-headless", "numba", "rasterio", "rerun-sdk")
_ENOUGH_DISK_GB = 2.0
_PROBE_LIMIT_S = 60

_SPHERE = """
<mujoco><worldbody><light pos="0 0 3"/><geom type="sphere" size="0.5" rgba="1 1 1 1"/>
<camera name="eye" pos="0 0 3"/></worldbody></mujoco>
"""


class Finding(NamedTuple):
    """One thing looked at: its name, whether it will do, what was found, and the line that mends it."""

    name: str
    ok: bool
    found: str
    remedy: str = ""

    def __str__(self) -> str:
        line = f"{'ok' if self.ok else 'LACKING':<8} {self.name}: {self.found}"
        return line if self.ok else f"{line}\n{'':<8} mend it by: {self.remedy}"


def examine(folder: Path) -> list[Finding]:
    """All findings about this machine; runs would be written below `folder`."""
    return [_python(), *(_package(name) for name in _PACKAGES), graphics(), _disk(folder), _processors()]


def graphics() -> Finding:
    """Whether a frame can be drawn without a screen."""
    try:
        command = [sys.executable, "-m", "twin.app.doctor"]
        probe = subprocess.run(command, capture_output=True, text=True, timeout=_PROBE_LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return Finding("OpenGL", False, f"drawing did not end within {_PROBE_LIMIT_S} s", _gl_remedy())
    if probe.returncode == 0:
        return Finding("OpenGL", True, probe.stdout.strip())
    lines = probe.stderr.strip().splitlines()
    found = lines[-1] if lines else f"drawing ended with status {probe.returncode}"
    return Finding("OpenGL", False, found, _gl_remedy())


def _gl_remedy() -> str:
    from scenes.gl import INSTALL_LINE

    return INSTALL_LINE if os.geteuid() == 0 else f"sudo {INSTALL_LINE}"


def _python() -> Finding:
    return Finding("Python", sys.version_info >= (3, 11), platform.python_version(), "install Python 3.11 or newer")


def _package(name: str) -> Finding:
    try:
        return Finding(name, True, version(name))
    except PackageNotFoundError:
        return Finding(name, False, "not installed", f"{sys.executable} -m pip install {name}")


def _disk(folder: Path) -> Finding:
    free_gb = shutil.disk_usage(folder).free / 1e9
    remedy = f"free {_ENOUGH_DISK_GB:g} GB, or choose another disk with --out"
    return Finding("disk", free_gb >= _ENOUGH_DISK_GB, f"{free_gb:.1f} GB free", remedy)


def _processors() -> Finding:
    return Finding("processors", True, f"{os.cpu_count()} ({platform.machine()})")


def draw_one_frame() -> str:
    """Draws a white sphere and reads it back.

    Returns:
        The name of what drew it.

    Raises:
        RuntimeError: nothing was drawn, or there is no OpenGL (`scenes.gl.GlMissing`).
    """
    from scenes.gl import mujoco, offscreen_context

    context = offscreen_context(64, 48)
    context.free()
    model = mujoco.MjModel.from_xml_string(_SPHERE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 48, 64) as renderer:
        renderer.update_scene(data, "eye")
        brightness = renderer.render().mean()
        from OpenGL.GL import GL_RENDERER, glGetString

        name = bytes(glGetString(GL_RENDERER) or b"a nameless renderer").decode()
    if brightness < 1:
        raise RuntimeError(f"{name} draws nothing but black")
    return f"{name} through {os.environ.get('MUJOCO_GL', 'the default')}"


def _probe() -> int:
    try:
        print(draw_one_frame())
    except Exception as error:  # the parent tells the user, whatever it is
        print(getattr(error, "problem", error), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_probe())
