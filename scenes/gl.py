"""MuJoCo for offscreen rendering, imported from here only: OpenGL's backend must be chosen before the import."""

from __future__ import annotations

import ctypes
import os
import sys
from functools import cache
from typing import Any, TypeAlias

from twin.errors import TwinError

INSTALL_LINE = "apt-get install -y libegl1 libgl1 libgl1-mesa-dri"


def _configure_egl() -> str:
    """Selects EGL on Linux unless MUJOCO_GL is set; returns why it does not work, or "".

    PyOpenGL 3.1.0, which pyrender pins, lacks the type EGLDeviceEXT, an opaque pointer.
    """
    if sys.platform != "linux" or os.environ.setdefault("MUJOCO_GL", "egl").strip().lower() != "egl":
        return ""
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    try:
        from OpenGL import EGL
    except (ImportError, AttributeError, OSError, TypeError) as error:  # PyOpenGL raises any of these without libEGL
        os.environ["MUJOCO_GL"] = "disabled"  # physics works without OpenGL
        return f"{type(error).__name__}: {error}"
    if not hasattr(EGL, "EGLDeviceEXT"):
        EGL.EGLDeviceEXT = ctypes.c_void_p  # pyright: ignore[reportAttributeAccessIssue]
    return ""


@cache
def _loaded() -> tuple[Any, str]:
    reason = _configure_egl()
    import mujoco

    return mujoco, reason


class _MuJoCo:
    """The module of MuJoCo, which is imported when its first attribute is used."""

    def __getattr__(self, name: str) -> Any:
        return getattr(_loaded()[0], name)


mujoco: Any = _MuJoCo()  #: Any: type checkers cannot read the compiled modules of MuJoCo
MjModel: TypeAlias = Any
MjSpec: TypeAlias = Any
MjsBody: TypeAlias = Any
MjvScene: TypeAlias = Any


def offscreen_context(width_px: int, height_px: int) -> Any:
    """Returns a current OpenGL context without a window; the caller must call its ``free()``.

    Raises TwinError, with the command that installs it, if OpenGL is missing.
    """
    if reason := _loaded()[1]:
        raise _opengl_missing(reason)
    try:
        if os.environ.get("MUJOCO_GL", "").strip().lower() == "egl":
            from mujoco.egl import GLContext  # works even if mujoco was imported before this module
        else:
            GLContext = mujoco.GLContext
        context = GLContext(width_px, height_px)
        context.make_current()
    except (ImportError, AttributeError, OSError, RuntimeError) as error:
        raise _opengl_missing(f"{type(error).__name__}: {error}") from error
    return context


def _opengl_missing(reason: str) -> TwinError:
    allowed = f"a working EGL; on Debian or Ubuntu, install it with: {INSTALL_LINE}"
    return TwinError("rendering", f"no OpenGL on this machine: {reason}", allowed)
