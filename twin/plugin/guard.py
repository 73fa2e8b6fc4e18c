"""Checked calls of plug-ins: an exception or an unusable value ends the survey with a reason that names the plug-in."""

import copy
from collections.abc import Callable, Sequence
from typing import Any, NoReturn

import numpy as np

from twin.core.geometry import Array
from twin.errors import SurveyAborted, TwinError, described
from twin.plugin import loading

#: Largest difference of R'R from the identity, and of det R from 1, for a rotation R of a pose.
_ROTATION_TOLERANCE = 1e-6
_MOST_HEIGHT_M = 1e4  # largest absolute height of a floor
_MOST_POSITION_M = 1e6  # largest absolute coordinate of a pose


class PluginFailed(SurveyAborted):
    """A plug-in raised an exception or returned an unusable value; the message names the plug-in."""


class GuardedPlugin:
    """Plug-in whose calls and results are checked. An object of the plug-in's class is created at the first call.

    `key`, `group` and `name` give the class (`loading.load`, which raises TwinError), `methods` what it must have.
    """

    def __init__(self, key: str, group: str, name: str, methods: Sequence[str], *arguments: Any):
        self.label = f"{key} {name}"
        self._create: Callable[..., Any] = loading.load(key, group, name)
        self._methods, self._arguments = methods, arguments
        self._plugin: Any = None

    def call(self, method: str, *arguments: Any) -> Any:
        """Returns the result of a method, which gets copies; raises PluginFailed if it fails or is missing."""
        if self._plugin is None:
            plugin = self._attempt("its class", self._create, self._arguments)
            if missing := [name for name in self._methods if not callable(getattr(plugin, name, None))]:
                raise PluginFailed(f"{self.label}: has no method {missing[0]}")
            self._plugin = plugin
        return self._attempt(method, getattr(self._plugin, method), arguments)

    def has(self, method: str) -> bool:
        """Returns whether the plug-in, which `call` has created, has a method that it may lack."""
        return self._attempt(method, lambda: callable(getattr(self._plugin, method, None)), ())

    def numbers(self, method: str, value: Any, shape: tuple[int, ...]) -> Array:
        """Returns the result of a method as floats; raises PluginFailed unless it has this shape and is finite."""
        try:
            array = np.array(value, dtype=np.float64)
        except Exception:  # conversion runs code of the value: a tensor with a gradient raises RuntimeError
            self.refuse(method, f"{type(value).__name__}", f"numbers of shape {shape}")
        if array.shape != shape:
            self.refuse(method, f"shape {array.shape}", f"{shape}")
        if not np.isfinite(array).all():
            n = np.count_nonzero(~np.isfinite(array))
            self.refuse(method, f"{n} of {array.size} numbers that are not finite", "finite numbers")
        return array

    def poses(self, method: str, value: Any, shape: tuple[int, ...]) -> Array:
        """Returns the result of a method, checked to be rigid poses; `shape` is (4, 4) or (n, 4, 4).

        Raises PluginFailed if these are not numbers of this shape, a rotation is not orthonormal with determinant 1, a
        last row is not (0, 0, 0, 1), or a coordinate is beyond `_MOST_POSITION_M`.
        """
        array = self.numbers(method, value, shape)
        rotation = array[..., :3, :3]
        error = np.abs(np.swapaxes(rotation, -1, -2) @ rotation - np.eye(3)).max(initial=0.0)
        turned = np.abs(np.linalg.det(rotation) - 1).max(initial=0.0)
        if max(error, turned) > _ROTATION_TOLERANCE:
            self.refuse(method, "a matrix that is no rotation", "an orthonormal rotation with determinant 1")
        if np.abs(array[..., 3, :] - [0, 0, 0, 1]).max(initial=0.0) > 0:
            self.refuse(method, "a last row that is not (0, 0, 0, 1)", "a rigid pose")
        if (largest := np.abs(array[..., :3, 3]).max(initial=0.0)) > _MOST_POSITION_M:
            self.refuse(method, f"a position of {largest:g} m", f"up to {_MOST_POSITION_M:g} m")
        return array

    def covariance(self, method: str, value: Any) -> Array:
        """Returns the result of a method; raises PluginFailed unless it is a covariance (6, 6)."""
        array = self.numbers(method, value, (6, 6))
        scale = np.abs(array).max()
        if np.abs(array - array.T).max() > 1e-9 * scale or np.linalg.eigvalsh(array)[0] < -1e-9 * scale:
            self.refuse(method, "a matrix that is no covariance", "symmetric and positive semidefinite")
        return array

    def refuse(self, method: str, returned: str, expected: str) -> NoReturn:
        raise PluginFailed(f"{self.label}: {method} returned {returned} (expected: {expected})")

    def _attempt(self, what: str, function: Callable[..., Any], arguments: Sequence[Any]) -> Any:
        try:
            return function(*copy.deepcopy(arguments))
        except (Exception, SystemExit) as error:  # a plug-in may raise any exception
            raise PluginFailed(f"{self.label}: {what} raised {described(error)}") from None


def check_loadable(key: str, group: str, name: str | None) -> None:
    if name is not None:
        loading.load(key, group, name)


def terrain_heights(name: str, x_m: Array, y_m: Array, seed: int) -> Array:
    """Returns heights (rows, cols) [m] of a floor from a terrain plug-in; raises TwinError if it fails."""
    key, shape = "terrain.plugin", (len(y_m), len(x_m))
    plugin = GuardedPlugin(key, loading.TERRAINS, name, ["heights"])
    try:
        height_m = plugin.numbers("heights", plugin.call("heights", x_m, y_m, seed), shape)
        if np.abs(height_m).max() > _MOST_HEIGHT_M:
            plugin.refuse("heights", f"a height of {np.abs(height_m).max():g} m", f"up to {_MOST_HEIGHT_M:g} m")
        return height_m
    except PluginFailed as error:
        raise TwinError(key, str(error).removeprefix(f"{key} ")) from None
