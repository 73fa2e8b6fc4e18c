"""MuJoCo, which is imported from here only, when it is first used. Surveys need none of its OpenGL."""

import os
from functools import cache
from typing import Any, TypeAlias


@cache
def _loaded() -> Any:
    try:
        import mujoco
    except (AttributeError, OSError, TypeError):  # the backend that MUJOCO_GL names is missing or unsuitable
        os.environ["MUJOCO_GL"] = "disabled"
        import mujoco
    return mujoco


class _MuJoCo:
    """The module of MuJoCo, which is imported when its first attribute is used."""

    def __getattr__(self, name: str) -> Any:
        return getattr(_loaded(), name)


mujoco: Any = _MuJoCo()  #: Any: type checkers cannot read the compiled modules of MuJoCo
MjModel: TypeAlias = Any
