"""Colour difference CIEDE2000 of linear RGB colours (Sharma, Wu & Dalal 2005, doi 10.1002/col.20070)."""

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Array

#: X, Y, Z (rows) of the primaries R, G, B (columns) of ITU-R BT.709 with the white point D65, relative to Y of white
#: (IEC 61966-2-1).
XYZ_FROM_RGB = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])
_25_TO_7 = 25.0**7


def lab_of(rgb: NDArray[np.floating]) -> Array:
    """Returns the CIELAB coordinates L*, a*, b* (..., 3) of linear RGB colours (..., 3), 1 = white (D65)."""
    relative = np.maximum(np.asarray(rgb, np.float64), 0) @ (XYZ_FROM_RGB / XYZ_FROM_RGB.sum(1, keepdims=True)).T
    edge = 6 / 29
    f = np.where(relative > edge**3, np.cbrt(relative), relative / (3 * edge**2) + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def ciede2000(first: Array, second: Array) -> Array:
    """Returns the CIEDE2000 differences (...) of pairs of CIELAB colours (..., 3); about 1 is barely visible."""
    l1, a1, b1 = np.moveaxis(np.asarray(first, np.float64), -1, 0)
    l2, a2, b2 = np.moveaxis(np.asarray(second, np.float64), -1, 0)
    mean_chroma = (np.hypot(a1, b1) + np.hypot(a2, b2)) / 2
    stretch = 1 + (1 - np.sqrt(mean_chroma**7 / (mean_chroma**7 + _25_TO_7))) / 2
    c1, c2 = np.hypot(stretch * a1, b1), np.hypot(stretch * a2, b2)
    h1, h2 = np.arctan2(b1, stretch * a1) % (2 * np.pi), np.arctan2(b2, stretch * a2) % (2 * np.pi)
    coloured = c1 * c2 > 0
    turn = np.where(coloured, (h2 - h1 + np.pi) % (2 * np.pi) - np.pi, 0.0)
    across = np.where(h1 + h2 < 2 * np.pi, np.pi, -np.pi) * (np.abs(h2 - h1) > np.pi)
    hue = np.where(coloured, (h1 + h2) / 2 + across, h1 + h2)
    lightness, chroma = (l1 + l2) / 2, (c1 + c2) / 2
    t = 1 - 0.17 * np.cos(hue - np.pi / 6) + 0.24 * np.cos(2 * hue)
    t += 0.32 * np.cos(3 * hue + np.pi / 30) - 0.20 * np.cos(4 * hue - np.deg2rad(63))
    s_l = 1 + 0.015 * (lightness - 50) ** 2 / np.sqrt(20 + (lightness - 50) ** 2)
    s_c, s_h = 1 + 0.045 * chroma, 1 + 0.015 * chroma * t
    rotation = -2 * np.sqrt(chroma**7 / (chroma**7 + _25_TO_7))
    rotation *= np.sin(np.deg2rad(60) * np.exp(-(((np.rad2deg(hue) - 275) / 25) ** 2)))
    dl, dc, dh = (l2 - l1) / s_l, (c2 - c1) / s_c, 2 * np.sqrt(c1 * c2) * np.sin(turn / 2) / s_h
    return np.sqrt(np.maximum(dl**2 + dc**2 + dh**2 + rotation * dc * dh, 0))
