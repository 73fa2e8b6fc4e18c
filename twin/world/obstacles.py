"""Obstacles with which the hull of the vehicle may come into contact: the floor and the objects of a mission."""

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.simulate.contact import FloorField, HullBox, floor_field, touches_floor, touches_mesh
from twin.simulate.parameters import parameters_of
from twin.world.mission import Mission


def floor_of(mission: Mission) -> FloorField:
    floor, rov = mission.terrain, parameters_of(mission.scenario.vehicle)
    box = HullBox(rov.half_size_m, rov.hull_centre_m)
    return floor_field(floor.height_m, floor.spacing_m, floor.west_m, floor.south_m, box)


class Obstacles:
    """Floor and objects of a mission. Plants are upright and rigid."""

    def __init__(self, mission: Mission):
        self._floor, self._objects = floor_of(mission), mission.objects
        self._centres_m = np.array([item.centre_m for item in self._objects]).reshape(-1, 3)
        self._radii_m = np.array([item.radius_m for item in self._objects])
        self._box_from_body = geometry.pose(np.eye(3), -self._floor.box.centre_m)

    def touched(self, world_from_body: Array) -> str:
        """Returns the obstacle that the hull touches at a pose (4, 4), in words; "" for none."""
        if touches_floor(self._floor, np.ascontiguousarray(world_from_body)):
            return "the floor"
        box_from_world = self._box_from_body @ geometry.inverse(world_from_body)
        for k in self._near(world_from_body):
            item = self._objects[k]
            mesh = item.model.levels[0].mesh
            vertices = geometry.transform(box_from_world @ item.world_from_object, mesh.vertices_m.astype(float))
            if touches_mesh(self._floor.box.half_m, np.ascontiguousarray(vertices), np.ascontiguousarray(mesh.faces)):
                return f"an object (objects.{item.group})"
        return ""

    def _near(self, world_from_body: Array) -> NDArray[np.intp]:
        box = self._floor.box
        centre_m, reach_m = geometry.transform(world_from_body, box.centre_m[None])[0], self._radii_m + box.reach_m
        return np.flatnonzero(((self._centres_m - centre_m) ** 2).sum(axis=1) < reach_m**2)
