"""Daylight on the floor in the axes of a camera, as the shading kernel expects it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from twin.imaging.light.daylight import FloorDaylight
from twin.kernels import kernel

Array = NDArray[np.float64]

_NO_CAUSTICS = np.zeros((0, 0), np.float32)
#: Rows and columns of the terms of a quadratic form in (n, 1), in the order of the argument `sky` of `shading.shade`.
_FIRST, _SECOND = np.array([[0, 1, 2, 0, 0, 1, 0, 1, 2, 3], [0, 1, 2, 1, 2, 2, 3, 3, 3, 3]])


class Sky:
    """Daylight on the floor, which `in_camera` returns in the axes of a camera.

    Args:
        daylight: daylight on floors of any slope.
        loss_per_m: (2, 3) attenuation with range from the camera of the light of lamps and of daylight [1/m].
    """

    def __init__(self, daylight: FloorDaylight, loss_per_m: Array):
        self._to_sun, self._rest_lx = daylight.to_sun, daylight.rest_lx
        self._beam = np.stack([daylight.beam_lx, daylight.beam_per_m], 1).astype(np.float32)
        self._change = np.ascontiguousarray(daylight.rest_per_m, np.float32)
        self._fitted = np.array([daylight.reference_depth_m, *daylight.fitted_m], np.float32)
        self._loss_per_m = np.ascontiguousarray(loss_per_m, np.float32)

    def in_camera(
        self, from_camera: Array, caustics: NDArray[np.float32] | None, day_loss_per_m: Array | None = None
    ) -> tuple:
        """Returns the argument `sky` of `shading.shade`.

        Args:
            from_camera, caustics: those of `optics.WaterSurface`.
            day_loss_per_m: (3,) attenuation of daylight with range from the camera [1/m]; None = that of `loss_per_m`.
        """
        to_sun, form = np.empty(3, np.float32), np.empty((len(self._rest_lx), len(_FIRST)), np.float32)
        _turn(world_axes(from_camera), self._to_sun, self._rest_lx, to_sun, form)
        loss = self._loss_per_m
        if day_loss_per_m is not None:
            loss = np.stack([loss[0], day_loss_per_m.astype(np.float32)])
        lines = _NO_CAUSTICS if caustics is None else caustics
        return to_sun, self._beam, form, self._change, self._fitted, loss, lines, from_camera.astype(np.float32)


@kernel(error_model="numpy")
def world_axes(from_camera):
    """Returns the unit vectors east, north and up in the axes of the camera, as columns (3, 3).

    Args:
        from_camera: (3, 4) that of `optics.WaterSurface`.
    """
    axes = np.empty((3, 3))
    for k in range(3):
        x, y, z = from_camera[k, 0], from_camera[k, 1], from_camera[k, 2]
        length = np.sqrt(x * x + y * y + z * z) * (-1 if k == 2 else 1)
        axes[0, k], axes[1, k], axes[2, k] = x / length, y / length, z / length
    return axes


@kernel(error_model="numpy")
def _turn(axes, to_sun, rest_lx, sun, form):
    """Fills `sun` (3,) with the direction to the sun, `form` (3, 10) with the quadratic form of `rest_lx`.

    Both are in the axes of the camera, as in the argument `sky` of `shading.shade`.

    Args:
        axes: (3, 3) unit vectors east, north and up in the axes of the camera, as columns.
        to_sun, rest_lx: those of `daylight.FloorDaylight`.
    """
    turn, half = np.eye(4), np.empty((4, 4))
    turn[:3, :3] = axes
    for i in range(3):
        sun[i] = axes[i, 0] * to_sun[0] + axes[i, 1] * to_sun[1] + axes[i, 2] * to_sun[2]
    for band in range(rest_lx.shape[0]):
        for i in range(4):
            for j in range(4):
                half[i, j] = 0.0
                for k in range(4):
                    half[i, j] += turn[i, k] * rest_lx[band, k, j]
        for term in range(_FIRST.size):
            i, j = _FIRST[term], _SECOND[term]
            total = 0.0
            for k in range(4):
                total += half[i, k] * turn[j, k]
            form[band, term] = total if i == j else 2 * total
