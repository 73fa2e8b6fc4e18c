"""Checks of this machine (Python, packages, rendering, disk space, processors), with a remedy for each failure.

`python -m twin.app.doctor` renders a test image, in a process of its own, which a faulty graphics driver can crash.
"""

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
<camera name="camera" pos="0 0 3"/></worldbody></mujoco>
"""


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
        check_rendering(),
        Check("disk", free_gb >= _ENOUGH_DISK_GB, f"{free_gb:.1f} GB free", remedy),
        Check("processors", True, f"{os.cpu_count()} ({platform.machine()})"),
    ]


def check_rendering() -> Check:
    """Returns the result of rendering an image with OpenGL, without a display, in a separate process."""
    from twin.scenes.gl import INSTALL_LINE

    remedy = INSTALL_LINE if os.geteuid() == 0 else f"sudo {INSTALL_LINE}"
    try:
        command = [sys.executable, "-P", "-m", "twin.app.doctor"]
        probe = subprocess.run(command, capture_output=True, text=True, timeout=_PROBE_LIMIT_S, check=False)
    except subprocess.TimeoutExpired:
        return Check("OpenGL", False, f"rendering did not finish within {_PROBE_LIMIT_S} s", remedy)
    if probe.returncode == 0:
        return Check("OpenGL", True, probe.stdout.strip())
    lines = probe.stderr.strip().splitlines()
    found = lines[-1] if lines else f"rendering failed with exit status {probe.returncode}"
    return Check("OpenGL", False, found, remedy)


def _package(name: str) -> Check:
    try:
        return Check(name, True, version(name))
    except PackageNotFoundError:
        return Check(name, False, "not installed", f"{sys.executable} -m pip install {name}")


def render_test_image() -> str:
    """Renders a white sphere; returns the name of the OpenGL renderer and the value of MUJOCO_GL as text.

    Raises TwinError if OpenGL is missing, RuntimeError if the rendered image is black.
    """
    from twin.scenes.gl import mujoco, offscreen_context

    context = offscreen_context(64, 48)
    context.free()
    model = mujoco.MjModel.from_xml_string(_SPHERE)
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    with mujoco.Renderer(model, 48, 64) as renderer:
        renderer.update_scene(data, "camera")
        brightness = renderer.render().mean()
        from OpenGL.GL import GL_RENDERER, glGetString

        name = bytes(glGetString(GL_RENDERER) or b"unnamed renderer").decode()
    if brightness < 1:
        raise RuntimeError(f"{name} renders a black image")
    return f"{name}, MUJOCO_GL={os.environ.get('MUJOCO_GL', 'default')}"


def _probe() -> int:
    try:
        print(render_test_image())
    except Exception as error:  # the parent process reports every kind of failure
        print(getattr(error, "problem", error), file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(_probe())
