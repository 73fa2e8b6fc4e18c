"""Plants that lean with the current, by the square of the height, and oscillate at the Strouhal frequency."""

import numpy as np

from twin.core.geometry import Array
from twin.terrains.objects.coloured_mesh import Mesh
from twin.terrains.objects.placed_object import PlacedObject

HALF_BENT_MPS = 0.5  #: current at which a plant leans by half of its largest lean
LARGEST_LEAN = 0.6  #: deflection of the tip in a strong current, as a fraction of the height
OSCILLATION = 0.25  #: amplitude of the oscillation, as a fraction of the lean
STROUHAL = 0.2  #: frequency of the oscillation times the width of the plant, divided by the speed of the current
WAVES = 0.5  #: number of waves along a plant


def swayed(mesh: Mesh, item: PlacedObject, current_mps: Array, time_s: float) -> Mesh:
    """Returns the mesh of a plant as the current (3,) bends it; unchanged without a horizontal current."""
    speed = float(np.hypot(*current_mps[:2]))
    if speed == 0:
        return mesh
    in_world = np.append(current_mps[:2] / speed, 0.0)
    direction = np.linalg.inv(item.world_from_object[:3, :3] / item.scale) @ in_world
    height_m = item.model.high_m[2]
    share = mesh.vertices_m[:, 2] / height_m  # fraction of the height
    lean = _lean(speed)
    width_m = item.scale * float((item.model.high_m - item.model.low_m)[:2].max())
    angle = 2 * np.pi * (STROUHAL * speed / width_m * time_s - WAVES * share) + item.phase
    deflection = height_m * lean * share**2 * (1 + OSCILLATION * np.sin(angle))
    vertices = mesh.vertices_m + deflection[:, None] * direction
    vertices[:, 2] -= deflection**2 / (2 * height_m)  # a bent plant keeps its length, approximately
    return mesh._replace(vertices_m=vertices.astype(np.float32))


def largest_displacement_m(item: PlacedObject, current_mps: Array) -> float:
    """Returns an upper bound of the distance by which `swayed` moves a vertex [m]; 0 if it does not sway."""
    if not item.model.sways:
        return 0.0
    aside = _lean(float(np.hypot(*current_mps[:2]))) * (1 + OSCILLATION)  # deflection of the tip / height
    down = aside**2 / 2  # along the axis of the plant, whose horizontal part may have the direction of the current
    tilt = float(np.hypot(*item.world_from_object[:2, 2])) / item.scale  # sine
    return float(item.scale * item.model.high_m[2] * np.sqrt(aside**2 + down**2 + 2 * aside * down * tilt))


def _lean(speed_mps: float) -> float:
    """Returns the mean deflection of the tip of a plant, as a fraction of its height."""
    return LARGEST_LEAN * speed_mps**2 / (speed_mps**2 + HALF_BENT_MPS**2)
