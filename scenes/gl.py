"""The one door to MuJoCo: ``from scenes.gl import mujoco`` makes sure that it can draw without a window.

MuJoCo imports PyOpenGL when it is imported itself, so what follows has to happen before, here and nowhere else.
"""

from __future__ import annotations

import ctypes
import os
import sys
from typing import Any, TypeAlias

INSTALL_LINE = "apt-get install -y libegl1 libgl1 libgl1-mesa-dri"


class GlMissing(RuntimeError):  # noqa: N818 (said as it is)
    """No OpenGL to draw with: the field, what is wrong, what would be right."""

    def __init__(self, problem: str):
        self.field, self.problem = "rendering", f"no OpenGL on this machine: {problem}"
        self.allowed = f"a working EGL, on Debian or Ubuntu by: {INSTALL_LINE}"
        super().__init__(f"{self.field}: {self.problem} (allowed: {self.allowed})")


def _prepare() -> str:
    """Chooses EGL unless told otherwise and mends old PyOpenGL; returns why EGL cannot be had ("" if it can).

    PyOpenGL 3.1.0, which pyrender pins, lacks the type EGLDeviceEXT that MuJoCo needs; it is an opaque pointer.
    """
    if sys.platform != "linux" or os.environ.setdefault("MUJOCO_GL", "egl").strip().lower() != "egl":
        return ""
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    try:
        from OpenGL import EGL
    except (ImportError, AttributeError, OSError, TypeError) as error:  # PyOpenGL's ways of saying: no libEGL
        os.environ["MUJOCO_GL"] = "disabled"  # physics works without
        return f"{type(error).__name__}: {error}"
    if not hasattr(EGL, "EGLDeviceEXT"):
        EGL.EGLDeviceEXT = ctypes.c_void_p  # pyright: ignore[reportAttributeAccessIssue]
    return ""


_why_missing = _prepare()

import mujoco as _mujoco  # noqa: E402

mujoco: Any = _mujoco  #: its names come from compiled modules, which type checkers cannot see into
#: For signatures: MuJoCo's model, its source and a body of that, what is drawn.
MjModel: TypeAlias = Any
MjSpec: TypeAlias = Any
MjsBody: TypeAlias = Any
MjvScene: TypeAlias = Any


def offscreen_context(width_px: int, height_px: int) -> Any:
    """A current OpenGL context without a window; ``free()`` gives it back.

    Raises:
        GlMissing: with the line that installs what is missing.
    """
    if _why_missing:
        raise GlMissing(_why_missing)
    try:
        if os.environ.get("MUJOCO_GL", "").strip().lower() == "egl":
            from mujoco.egl import GLContext  # also where somebody imported mujoco before this module
        else:
            GLContext = mujoco.GLContext
        context = GLContext(width_px, height_px)
        context.make_current()
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        raise GlMissing(f"{type(error).__name__}: {error}") from error
    return context
