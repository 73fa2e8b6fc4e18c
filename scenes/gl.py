"""MuJoCo, which is imported from here only, when it is first used. Surveys need none of its OpenGL."""

import os
from ctypes import c_void_p
from functools import cache
from importlib import import_module
from typing import Any, TypeAlias


@cache
def _loaded() -> Any:
    try:
        import mujoco
    except (AttributeError, OSError, TypeError):  # the backend that MUJOCO_GL names is missing or unsuitable
        os.environ["MUJOCO_GL"] = "disabled"
        import mujoco
    return mujoco


def draw_with_egl() -> None:
    """Makes `mujoco.Renderer` use EGL. PyOpenGL 3.1.0 lacks EGLDeviceEXT, an opaque pointer."""
    os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    egl: Any = import_module("OpenGL.EGL")
    egl.EGLDeviceEXT = getattr(egl, "EGLDeviceEXT", c_void_p)
    import_module("mujoco.rendering.classic.gl_context").GLContext = import_module("mujoco.egl").GLContext


class _MuJoCo:
    """The module of MuJoCo, which is imported when its first attribute is used."""

    def __getattr__(self, name: str) -> Any:
        return getattr(_loaded(), name)


mujoco: Any = _MuJoCo()  #: Any: type checkers cannot read the compiled modules of MuJoCo
MjModel: TypeAlias = Any
