"""MuJoCo model of the scene: the seafloor, a free-floating BlueROV2, its cameras and lamps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.scenes.bluerov2 import BLUEROV2_HEAVY, VehicleParameters
from twin.scenes.floor import add_floor
from twin.scenes.gl import MjModel, MjsBody, MjSpec, mujoco
from twin.terrains import Terrain

VEHICLE_GROUP = 2  #: geom group of the vehicle, which the survey's cameras do not render
CAMERAS = ("left", "right")


@dataclass(frozen=True)
class CameraPair:
    """Intrinsics and poses of the stereo rig, whose two cameras have the same intrinsics and orientation.

    Args:
        width_px, height_px: width and height of each image.
        vfov_deg: vertical field of view.
        baseline_m: distance of the right camera from the left one, along the left camera's +x axis.
        body_from_camera: (4, 4) pose of the left camera in the body; camera axes x right, y down, z forward.
    """

    width_px: int
    height_px: int
    vfov_deg: float
    baseline_m: float
    body_from_camera: Array


@dataclass(frozen=True)
class SceneModel:
    """Compiled MuJoCo model and the ids of its parts.

    Args:
        model: compiled model; its users create their own MjData.
        terrain: the terrain from which the floor was built.
        tile_geom_ids: (n,) geom ids of the floor tiles.
        tile_low_m, tile_high_m: (n, 3) minimum and maximum corners of the tiles' bounding boxes in the world.
        body_id: id of the vehicle's body; its free joint is qpos[0:7] (position, quaternion wxyz) and qvel[0:6].
        camera_ids: ids of the left and the right camera.
        thruster_site_ids: (8,) site ids in the order of `VehicleParameters`; thrust acts along the z axis of a site.
        lamp_site_ids: (n,) site ids in the order of the lamp positions.
    """

    model: MjModel
    terrain: Terrain
    tile_geom_ids: NDArray[np.int64]
    tile_low_m: Array
    tile_high_m: Array
    body_id: int
    camera_ids: tuple[int, int]
    thruster_site_ids: NDArray[np.int64]
    lamp_site_ids: NDArray[np.int64]


def build(
    terrain: Terrain,
    cameras: CameraPair,
    timestep_s: float,
    lamp_positions_m: Sequence[Sequence[float]] | Array = (),
) -> SceneModel:
    """Compiles the floor and the vehicle into one MuJoCo model.

    The model contains gravity; `twin.simulate` adds buoyancy, drag and thrust.

    Args:
        lamp_positions_m: (n, 3) positions of the lamps in the body.
    """
    spec = _empty_model(cameras.width_px, cameras.height_px, timestep_s)
    tiles = add_floor(spec, terrain)
    body = _add_vehicle(spec, BLUEROV2_HEAVY)
    _add_cameras(body, cameras)
    for k, position in enumerate(lamp_positions_m):
        body.add_site(name=f"lamp_{k}", pos=np.asarray(position, dtype=np.float64), group=VEHICLE_GROUP)
    model = spec.compile()
    return SceneModel(
        model=model,
        terrain=terrain,
        tile_geom_ids=np.array([model.geom(tile.name).id for tile in tiles]),
        tile_low_m=np.array([tile.low_m for tile in tiles]),
        tile_high_m=np.array([tile.high_m for tile in tiles]),
        body_id=model.body("vehicle").id,
        camera_ids=(model.camera(CAMERAS[0]).id, model.camera(CAMERAS[1]).id),
        thruster_site_ids=np.array([model.site(f"thruster_{k}").id for k in range(8)]),
        lamp_site_ids=np.array([model.site(f"lamp_{k}").id for k in range(len(lamp_positions_m))], dtype=np.int64),
    )


def _empty_model(image_width_px: int, image_height_px: int, timestep_s: float) -> MjSpec:
    """Returns a model specification without bodies; lights, shadows and multisampling are off."""
    spec = mujoco.MjSpec()
    spec.modelname = "seabed"
    spec.option.timestep = timestep_s
    spec.stat.extent = 1.0  # MuJoCo multiplies the clipping distances by the extent
    spec.visual.headlight.active = 0
    spec.visual.quality.offsamples = 0  # with multisampling, depth would be displaced by a fraction of a pixel
    spec.visual.quality.shadowsize = 0
    spec.visual.global_.offwidth, spec.visual.global_.offheight = image_width_px, image_height_px
    return spec


def _add_vehicle(spec: MjSpec, vehicle: VehicleParameters) -> MjsBody:
    """Adds and returns the body: origin at the centre of gravity, a visual hull and a site at each thruster."""
    body = spec.worldbody.add_body(name="vehicle")
    body.add_freejoint(name="vehicle")
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = vehicle.mass_kg, np.zeros(3), vehicle.inertia_kgm2
    _add_hull(body, vehicle)
    pairs = zip(vehicle.thruster_positions_m, vehicle.thruster_directions, strict=True)
    for k, (position, direction) in enumerate(pairs):
        quaternion = np.zeros(4)
        mujoco.mju_quatZ2Vec(quaternion, direction)
        body.add_site(name=f"thruster_{k}", pos=position, quat=quaternion, size=[0.04] * 3, group=VEHICLE_GROUP)
    return body


def _add_hull(body: MjsBody, vehicle: VehicleParameters) -> None:
    """Adds two boxes without mass: a blue one (buoyancy foam) and, lower, a black one (chassis)."""
    length, width, height = vehicle.size_m / 2
    common = {"type": mujoco.mjtGeom.mjGEOM_BOX, "group": VEHICLE_GROUP, "mass": 0.0, "contype": 0, "conaffinity": 0}
    body.add_geom(name="float", size=[length, width, height / 4], pos=[0, 0, 0.075], rgba=[0.1, 0.35, 0.8, 1], **common)
    body.add_geom(
        name="frame", size=[length, width / 2, height / 2], pos=vehicle.hull_centre_m, rgba=[0.1] * 3 + [1], **common
    )


def _add_cameras(body: MjsBody, cameras: CameraPair) -> None:
    """Adds the stereo pair; a MuJoCo camera has y up and points along -z."""
    body_from_camera = cameras.body_from_camera
    rotation = body_from_camera[:3, :3] @ np.diag([1.0, -1.0, -1.0])
    quaternion = np.zeros(4)
    mujoco.mju_mat2Quat(quaternion, np.ascontiguousarray(rotation).ravel())
    for name, offset_m in zip(CAMERAS, (0.0, cameras.baseline_m), strict=True):
        position = body_from_camera[:3, 3] + offset_m * body_from_camera[:3, 0]
        body.add_camera(name=name, pos=position, quat=quaternion, fovy=cameras.vfov_deg)
