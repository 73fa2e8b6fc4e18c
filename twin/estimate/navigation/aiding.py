"""Factors of the navigation sensors in the graph of the global alignment.

The scale error of the DVL is one parameter shared by all displacements: as noise of each, it would average out.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import symmetric_inverses
from twin.core.records import SensorNoise, StereoRig
from twin.estimate.adjustment import BinaryFactors, UnaryFactors, pose_residual_jacobians, pose_residuals
from twin.estimate.navigation import pose_filter
from twin.estimate.navigation.dvl import body_displacement
from twin.estimate.vision.keyframes import Keyframe
from twin.kernels import kernel


def unary_factors(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> list[UnaryFactors]:
    """Returns the factors of pressure, attitude, position fixes, beacons and verticals, in this order.

    All residuals are predicted minus measured.

    Args:
        nodes: nodes, in the order of the poses in the graph.
    """
    return [
        _height_factors(nodes, noise),
        _attitude_factors(nodes, rig, noise),
        _position_factors(nodes, noise),
        _beacon_factors(nodes, rig, noise),
        _vertical_factors(nodes, rig, noise),
    ]


def _height_factors(nodes: Sequence[Keyframe], noise: SensorNoise) -> UnaryFactors:
    index = [k for k, node in enumerate(nodes) if node.readings.pressure_z_m is not None]
    height_m = np.array([nodes[k].readings.pressure_z_m for k in index], dtype=np.float64)

    def jacobians(poses: Array, _: Array) -> Array:
        by_pose = np.zeros((len(poses), 1, 6))
        by_pose[:, 0, 3:] = poses[:, 2, :3]
        return by_pose

    information = np.full((len(index), 1, 1), noise.pressure_m**-2)
    return UnaryFactors(
        np.array(index, np.int64), information, lambda poses: poses[:, 2, 3:] - height_m[:, None], jacobians
    )


def _attitude_factors(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> UnaryFactors:
    index = [k for k, node in enumerate(nodes) if node.readings.ahrs_rpy_rad is not None]
    angles = np.array([nodes[k].readings.ahrs_rpy_rad for k in index]).reshape(-1, 3)
    camera_from_body = geometry.inverse(rig.body_from_camera)
    cov = pose_filter.camera_attitude(np.zeros(3), camera_from_body, noise)[1]  # independent of the angles
    measured = _camera_poses_at_origin(angles, rig.body_from_camera)

    def residuals(poses: Array) -> Array:
        rotations = poses.copy()
        rotations[:, :3, 3] = 0.0
        return pose_residuals(measured, rotations)[:, :3]

    def jacobians(_: Array, residuals: Array) -> Array:
        return pose_residual_jacobians(np.column_stack([residuals, np.zeros_like(residuals)]))[:, :3]

    information = np.tile(symmetric_inverses(cov[None]), (len(index), 1, 1))
    return UnaryFactors(np.array(index, np.int64), information, residuals, jacobians)


@kernel
def _camera_poses_at_origin(angles, body_from_camera):
    """Returns world_from_camera (m, 4, 4), with zero translation, for roll, pitch and yaw (m, 3) of the body [rad]."""
    poses, mount_rotation = np.empty((len(angles), 4, 4)), body_from_camera.copy()
    mount_rotation[:3, 3] = 0.0
    for k in range(len(angles)):
        body = geometry.pose(geometry.rotation_from_rpy(angles[k, 0], angles[k, 1], angles[k, 2]), np.zeros(3))
        geometry.copy_into(poses[k], geometry.compose(body, mount_rotation))
    return poses


def _position_factors(nodes: Sequence[Keyframe], noise: SensorNoise) -> UnaryFactors:
    index = [k for k, node in enumerate(nodes) if node.readings.usbl_m is not None]
    position_m = np.array([nodes[k].readings.usbl_m for k in index]).reshape(-1, 3)

    def jacobians(poses: Array, _: Array) -> Array:
        by_pose = np.zeros((len(poses), 3, 6))
        by_pose[:, :, 3:] = poses[:, :3, :3]
        return by_pose

    information = np.tile(np.eye(3) * noise.usbl_m**-2, (len(index), 1, 1))
    return UnaryFactors(np.array(index, np.int64), information, lambda poses: poses[:, :3, 3] - position_m, jacobians)


def _beacon_factors(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> UnaryFactors:
    """Returns the factors of the beacons seen in the left image.

    The residuals are the predicted minus the detected positions [px]; 0 for a beacon predicted behind the camera.
    """
    sightings = [(k, sighting) for k, node in enumerate(nodes) for sighting in node.readings.beacons or ()]
    beacon_m = np.array([noise.beacons_m[sighting.beacon] for _, sighting in sightings]).reshape(-1, 3)
    pixels = np.array([sighting.pixel for _, sighting in sightings]).reshape(-1, 2)

    def evaluate(poses: Array) -> tuple[Array, Array]:
        residuals, by_pose = np.zeros((len(poses), 2)), np.zeros((len(poses), 2, 6))
        for k, pose in enumerate(poses):
            expected, jacobian = pose_filter.project_beacon(pose, beacon_m[k], rig)
            if np.isfinite(expected).all():  # a beacon behind the camera adds no constraint
                residuals[k], by_pose[k] = expected - pixels[k], jacobian
        return residuals, by_pose

    index = np.array([k for k, _ in sightings], np.int64)
    information = np.tile(np.eye(2) * noise.beacon_px**-2, (len(index), 1, 1))
    return UnaryFactors(index, information, lambda poses: evaluate(poses)[0], lambda poses, _: evaluate(poses)[1])


def _vertical_factors(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> UnaryFactors:
    """Returns the factors of the verticals measured by an IMU.

    The residuals (m, 2) are the components of the predicted vertical perpendicular to the measured one, in the camera.
    The error of the accelerometer is common to all n readings, so each has n times the variance: all together, they
    determine the direction as precisely as one.
    """
    index = [k for k, node in enumerate(nodes) if node.readings.up is not None]
    measured = np.array([nodes[k].readings.up for k in index]).reshape(-1, 3) @ rig.body_from_camera[:3, :3]
    across = np.array([pose_filter.perpendicular_axes(up) for up in measured]).reshape(-1, 2, 3)

    def jacobians(poses: Array, _: Array) -> Array:
        by_pose = np.zeros((len(poses), 2, 6))
        by_pose[:, :, :3] = across @ np.array([geometry.skew(up) for up in poses[:, 2, :3]]).reshape(-1, 3, 3)
        return by_pose

    information = np.tile(np.eye(2) * noise.up_rad**-2 / max(len(index), 1), (len(index), 1, 1))
    return UnaryFactors(
        np.array(index, np.int64),
        information,
        lambda poses: np.einsum("nij,nj->ni", across, poses[:, 2, :3]),
        jacobians,
    )


def displacement_factors(nodes: Sequence[Keyframe], rig: StereoRig) -> BinaryFactors:
    """Returns the factors of the displacements between nodes measured by the DVL: measured = (1 + s) d + noise.

    d is the displacement of the body's origin, in the body axes at the earlier node; s is the scale error of the DVL,
    one parameter shared by all factors. A displacement whose earlier node is not in `nodes` is left out.

    Args:
        nodes: nodes, in the order of the poses in the graph.
    """
    index_of = {node.number: k for k, node in enumerate(nodes)}
    with_dvl = [(k, node.dvl_displacement) for k, node in enumerate(nodes) if node.dvl_displacement is not None]
    pairs = [(index_of[d.since], k, d) for k, d in with_dvl if d.since in index_of]
    i, j = (np.array([pair[end] for pair in pairs], np.int64) for end in (0, 1))
    measured_m = np.array([d.displacement_m for _, _, d in pairs]).reshape(-1, 3)
    information = symmetric_inverses(np.array([d.cov for _, _, d in pairs]).reshape(-1, 3, 3))

    def residuals(i_from_j: Array, scale: float) -> Array:
        return (1 + scale) * _body_displacements(i_from_j, rig.body_from_camera)[0] - measured_m

    def jacobians(i_from_j: Array, scale: float, _: Array) -> tuple[Array, Array]:
        displacements, by_j = _body_displacements(i_from_j, rig.body_from_camera)
        return (1 + scale) * by_j, displacements

    return BinaryFactors(i, j, information, residuals, jacobians)


@kernel
def _body_displacements(motions, body_from_camera):
    """Returns the displacements (m, 3) [m] and Jacobians (m, 3, 6) from `body_displacement` for motions (m, 4, 4)."""
    displacements, by_motion = np.empty((len(motions), 3)), np.empty((len(motions), 3, 6))
    for k in range(len(motions)):
        displacement, jacobian = body_displacement(motions[k], body_from_camera)
        geometry.copy_into(displacements[k], displacement)
        geometry.copy_into(by_motion[k], jacobian)
    return displacements, by_motion
