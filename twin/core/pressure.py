"""Increase of the pressure of sea water with depth."""

from __future__ import annotations

_WATER_KG_M3, _GRAVITY_MPS2 = 1025.0, 9.81
#: Increase of the pressure of sea water with depth [Pa/m].
PASCAL_PER_METRE = _WATER_KG_M3 * _GRAVITY_MPS2
