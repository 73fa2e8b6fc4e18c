"""Objects ready for rendering: models with levels of detail, and objects placed in the world."""

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.errors import TwinError
from twin.terrains.objects.coloured_mesh import Mesh, extent, is_closed, standing
from twin.terrains.objects.detail import Level, levels_of


class ObjectModel(NamedTuple):
    """Shape of objects, standing on z = 0 and centred at x = y = 0, or a tile of a mesh floor in world coordinates."""

    levels: tuple[Level, ...]  #: levels of detail, finest first
    low_m: Array  #: (3,) minimum and maximum corner of the bounding box
    high_m: Array
    centre_m: Array  #: (3,) centre and radius of a bounding sphere
    radius_m: float
    sways: bool = False  #: whether the object bends in the current
    closed: bool = False  #: whether the mesh encloses a volume, so that only triangles that face the viewer are seen

    @property
    def size_m(self) -> float:
        return float((self.high_m - self.low_m).max())


class PlacedObject(NamedTuple):
    model: ObjectModel
    world_from_object: Array  #: (4, 4) pose, with its rotation multiplied by the scale
    scale: float  #: size in the world divided by the size of the model
    group: int  #: number, from 0, of the object's entry in `[[objects]]`; -1 for a tile of a mesh floor
    phase: float = 0.0  #: phase of its sway [rad]

    @property
    def centre_m(self) -> Array:
        return self.world_from_object[:3, :3] @ self.model.centre_m + self.world_from_object[:3, 3]

    @property
    def radius_m(self) -> float:
        return self.scale * self.model.radius_m

    def corners_m(self) -> Array:
        """Returns the corners (8, 3) of the bounding box in the world [m]; the box has the axes of the object."""
        corners = np.where(np.array(list(np.ndindex(2, 2, 2)), bool), self.model.high_m, self.model.low_m)
        return corners @ self.world_from_object[:3, :3].T + self.world_from_object[:3, 3]


def grown(item: PlacedObject, growth_m: float, field: str) -> PlacedObject:
    """Returns an object whose height has increased by `growth_m` about its base; `field` is that of the TwinError."""
    height_m = item.scale * float(item.model.high_m[2])
    if growth_m <= -height_m or not height_m:
        raise TwinError(field, f"{growth_m:g}: an object is {height_m:.3g} m high", f"more than {-height_m:.3g}")
    factor = 1 + growth_m / height_m
    pose = item.world_from_object.copy()
    pose[:3, :3] *= factor
    return item._replace(world_from_object=pose, scale=item.scale * factor)


def model_of(mesh: Mesh, sways: bool = False) -> ObjectModel:
    mesh = standing(mesh)
    return model_with(levels_of(mesh), sways, is_closed(mesh))


def model_with(levels: tuple[Level, ...], sways: bool = False, closed: bool = False) -> ObjectModel:
    low, high = extent(levels[0].mesh)
    centre = (low + high) / 2
    radius_m = float(np.linalg.norm(levels[0].mesh.vertices_m - centre, axis=1).max())
    return ObjectModel(levels, low, high, centre, radius_m, sways, closed)
