"""Objects in the images of the cameras: drawn over the rendered floor where they are nearer to the camera.

Plants lean with the current, by the square of the height, and oscillate at the Strouhal frequency.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.records import Array, Depth, Image, StereoRig
from twin.imaging.scene.mesh_raster import NEAR_M, DrawnMesh, ObjectView, Projection, Target, draw_meshes, view_planes
from twin.imaging.scene.mesh_texture import paint_textures
from twin.terrains.objects.coloured_mesh import Mesh
from twin.terrains.objects.detail import UNKNOWN
from twin.terrains.objects.floor_mesh import FloorTiles
from twin.terrains.objects.placed_object import PlacedObject
from twin.terrains.objects.texture_pyramid import Textures

LEVEL_PX = 1.0  #: largest side of the cells of a level of detail, in the image [px]
HALF_BENT_MPS = 0.5  #: current at which a plant leans by half of its largest lean
LARGEST_LEAN = 0.6  #: deflection of the tip in a strong current, as a fraction of the height
OSCILLATION = 0.25  #: amplitude of the oscillation, as a fraction of the lean
STROUHAL = 0.2  #: frequency of the oscillation times the width of the plant, divided by the speed of the current
WAVES = 0.5  #: number of waves along a plant


class Objects:
    """Objects in the world; plants sway in the current (3,). The tiles of a mesh floor follow, as objects."""

    def __init__(
        self, placed: Sequence[PlacedObject], current_mps: Array | None = None, floor: FloorTiles | None = None
    ):
        tiles = () if floor is None else floor.tiles
        n_objects = len(placed)
        self.placed = placed = (*placed, *(tile.placed for tile in tiles))
        #: `FloorTile.uv` of the tiles with a texture; None for all other meshes
        self.uv = [None] * n_objects + [tile.uv if tile.texture >= 0 else None for tile in tiles]
        self.surface: tuple[Textures, NDArray[np.int32]] | None = None  # with the numbers of textures by labels
        if floor is not None and len(floor.textures.levels):
            of_label = [-1] * (1 + n_objects) + [tile.texture for tile in tiles]
            self.surface = floor.textures, np.array(of_label, np.int32)
        self._current_mps = np.zeros(3) if current_mps is None else current_mps
        self._centres_m = np.array([item.centre_m for item in placed]).reshape(-1, 3)
        self._radii_m = np.array([item.radius_m + largest_displacement_m(item, self._current_mps) for item in placed])

    def in_view(
        self, camera_from_world: Array, view: Projection, shape: tuple[int, int], time_s: float
    ) -> list[DrawnMesh]:
        """Returns the meshes in a view of (rows, cols) pixels, by depth; their labels are 1 + the index in `placed`."""
        limits = view_planes(view, shape)
        centres = self._centres_m @ camera_from_world[:3, :3].T + camera_from_world[:3, 3]
        visible = np.all(centres @ limits[:, :3].T + limits[:, 3] >= -self._radii_m[:, None], axis=1)
        order = np.flatnonzero(visible)
        drawn = []
        for k in order[np.argsort(centres[order, 2])]:
            item = self.placed[k]
            nearest_m = max(centres[k, 2] - self._radii_m[k], view.near_m)
            pixel_m = (nearest_m if view.perspective else 1.0) / view.focal_px
            fine = [level for level in item.model.levels if level.cell_m * item.scale <= LEVEL_PX * pixel_m]
            mesh, _, parts = fine[-1]
            if item.model.sways:
                mesh, parts = swayed(mesh, item, self._current_mps, time_s), UNKNOWN
            transform, closed = camera_from_world @ item.world_from_object, item.model.closed
            drawn.append(DrawnMesh(mesh, transform, int(k) + 1, closed, parts, self.uv[k]))
        return drawn


def draw_objects(
    objects: Objects, target: Target, camera_from_world: Array, projection: Projection, time_s: float = 0.0
) -> None:
    """Draws the objects in view into images, labelled by their numbers + 1, and the textures of a mesh floor."""
    height, width = target.depth.shape
    draw_meshes(objects.in_view(camera_from_world, projection, (height, width), time_s), projection, target)
    if objects.surface is not None:
        paint_textures(target, projection, *objects.surface)


def draw_over_floor(
    objects: Objects, rig: StereoRig, albedo: Image, depth: Depth, world_from_camera: Array, time_s: float
) -> ObjectView:
    """Draws the objects into `albedo` (H, W, 3) and `depth` (H, W) [m] of the floor in place; returns their view."""
    view = ObjectView(np.empty((*depth.shape, 3), np.float32), np.zeros(depth.shape, np.uint16))
    uv = None if objects.surface is None else np.empty((*depth.shape, 3), np.float32)
    projection = Projection(rig.focal_px, rig.cx_px, rig.cy_px, NEAR_M, True)
    draw_objects(objects, Target(depth, albedo, *view, uv), geometry.inverse(world_from_camera), projection, time_s)
    return view


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
