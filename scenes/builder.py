"""MuJoCo model of the scene: the seafloor and a free-floating BlueROV2, which is a mass without a shape."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.scenes.bluerov2 import BLUEROV2_HEAVY
from twin.scenes.floor import add_floor
from twin.scenes.gl import MjModel, mujoco
from twin.terrains import Terrain


class SceneModel(NamedTuple):
    """Compiled MuJoCo model; its users create their own MjData.

    The free joint of its body "vehicle" is qpos[0:7] (position, quaternion wxyz) and qvel[0:6]. `tile_geom_ids` (n,)
    are the geoms of the floor tiles; `tile_low_m`, `tile_high_m` (n, 3) are the corners of their bounding boxes.
    """

    model: MjModel
    terrain: Terrain
    tile_geom_ids: NDArray[np.int64]
    tile_low_m: Array
    tile_high_m: Array


def build(terrain: Terrain, timestep_s: float) -> SceneModel:
    """Compiles the floor and the vehicle into one MuJoCo model, without lights, shadows and multisampling.

    The model contains gravity; `twin.simulate` adds buoyancy, drag and thrust.
    """
    spec = mujoco.MjSpec()
    spec.modelname = "seabed"
    spec.option.timestep = timestep_s
    spec.stat.extent = 1.0  # MuJoCo multiplies the clipping distances by the extent
    spec.visual.headlight.active = 0
    spec.visual.quality.offsamples = 0  # with multisampling, depth would be displaced by a fraction of a pixel
    spec.visual.quality.shadowsize = 0
    tiles = add_floor(spec, terrain)
    body = spec.worldbody.add_body(name="vehicle")  # its origin is the centre of gravity
    body.add_freejoint(name="vehicle")
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = BLUEROV2_HEAVY.mass_kg, np.zeros(3), BLUEROV2_HEAVY.inertia_kgm2
    model = spec.compile()
    ids, low_m, high_m = zip(*((model.geom(tile.name).id, tile.low_m, tile.high_m) for tile in tiles), strict=True)
    return SceneModel(model, terrain, np.array(ids), np.array(low_m), np.array(high_m))
