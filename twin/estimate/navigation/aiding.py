"""Factors of the navigation sensors in the graph of the global alignment; residuals are predicted minus measured."""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import symmetric_inverses
from twin.core.records import SensorNoise, StereoRig
from twin.estimate.adjustment.pose_graph import BinaryFactors, UnaryFactors, pose_residual_jacobians, pose_residuals
from twin.estimate.navigation import pose_filter
from twin.estimate.navigation.dvl import body_displacement
from twin.estimate.vision.stereo import Keyframe
from twin.kernels import kernel


def unary_factors(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> list[UnaryFactors]:
    """Returns the factors of pressure, attitude, position fixes, beacons and verticals of nodes in their order."""
    return [
        _coordinate_factors(nodes, "pressure_z_m", 2, noise.height_sigma_m),
        _attitude_factors(nodes, rig, noise),
        _coordinate_factors(nodes, "usbl_m", 0, noise.usbl_m),
        _beacon_factors(nodes, rig, noise),
        _vertical_factors(nodes, rig, noise),
    ]


def _readings(nodes: Sequence[Keyframe], name: str) -> tuple[NDArray[np.int64], Any]:
    """Returns the indices (m,) of the nodes with a reading of this name, and their readings (m, ...)."""
    index = [k for k, node in enumerate(nodes) if getattr(node.readings, name) is not None]
    return np.array(index, np.int64), np.array([getattr(nodes[k].readings, name) for k in index], np.float64)


def _factors(
    index: NDArray[np.int64], information: Array, residuals: Callable[[Array], Array],
    jacobians: Callable[[Array, Array], Array],
) -> UnaryFactors:  # fmt: skip
    """Returns factors with the same information matrix (d, d)."""
    return UnaryFactors(index, np.tile(information, (len(index), 1, 1)), residuals, jacobians)


def _coordinate_factors(nodes: Sequence[Keyframe], name: str, first: int, sigma_m: float) -> UnaryFactors:
    """Returns the factors of readings of the coordinates of the camera in the world, from axis `first` on."""
    index, measured_m = _readings(nodes, name)
    measured_m = measured_m.reshape(-1, 3 - first)

    def jacobians(poses: Array, _: Array) -> Array:
        rotations = poses[:, first:3, :3]
        return np.concatenate([np.zeros_like(rotations), rotations], axis=2)

    information = np.eye(3 - first) * sigma_m**-2
    return _factors(index, information, lambda poses: poses[:, first:3, 3] - measured_m, jacobians)


def _attitude_factors(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> UnaryFactors:
    index, angles = _readings(nodes, "ahrs_rpy_rad")
    camera_from_body, origin = geometry.inverse(rig.body_from_camera), np.zeros(3)
    cov = pose_filter.camera_attitude(origin, camera_from_body, noise.attitude_sigmas_rad)[1]  # for any angles
    mount = geometry.pose(rig.body_from_camera[:3, :3], origin)
    bodies = [geometry.pose(geometry.rotation_from_rpy(*rpy_rad), origin) for rpy_rad in angles]
    measured = np.array([geometry.compose(body, mount) for body in bodies]).reshape(-1, 4, 4)

    def residuals(poses: Array) -> Array:
        rotations = poses.copy()
        rotations[:, :3, 3] = 0.0
        return pose_residuals(measured, rotations)[:, :3]

    def jacobians(_: Array, residuals: Array) -> Array:
        return pose_residual_jacobians(np.column_stack([residuals, np.zeros_like(residuals)]))[:, :3]

    return _factors(index, symmetric_inverses(cov[None])[0], residuals, jacobians)


def _beacon_factors(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> UnaryFactors:
    """Returns the factors of the beacons seen in the left image; a beacon predicted behind the camera adds nothing."""
    sightings = [(k, sighting) for k, node in enumerate(nodes) for sighting in node.readings.beacons or ()]
    beacon_m = [np.array(noise.beacons_m[sighting.beacon], np.float64) for _, sighting in sightings]

    def evaluate(poses: Array) -> tuple[Array, Array]:
        residuals, by_pose = np.zeros((len(poses), 2)), np.zeros((len(poses), 2, 6))
        for k, pose in enumerate(poses):
            expected, jacobian = pose_filter.project_beacon(pose, beacon_m[k], rig)
            if np.isfinite(expected).all():
                residuals[k], by_pose[k] = expected - sightings[k][1].pixel, jacobian
        return residuals, by_pose

    index = np.array([k for k, _ in sightings], np.int64)
    information = np.eye(2) * noise.beacon_px**-2
    return _factors(index, information, lambda poses: evaluate(poses)[0], lambda poses, _: evaluate(poses)[1])


def _vertical_factors(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> UnaryFactors:
    """Returns the factors of the verticals measured by an IMU."""
    # residuals (m, 2): components of the predicted vertical perpendicular to the measured one, in the camera; the error
    # of the accelerometer is common to all n readings, so each has n times the variance
    index, up = _readings(nodes, "up")
    measured = up.reshape(-1, 3) @ rig.body_from_camera[:3, :3]
    across = np.array([pose_filter.perpendicular_axes(axis) for axis in measured]).reshape(-1, 2, 3)

    def jacobians(poses: Array, _: Array) -> Array:
        by_pose = np.zeros((len(poses), 2, 6))
        by_pose[:, :, :3] = across @ np.array([geometry.skew(axis) for axis in poses[:, 2, :3]]).reshape(-1, 3, 3)
        return by_pose

    information = np.eye(2) * noise.up_rad**-2 / max(len(index), 1)
    return _factors(index, information, lambda poses: np.einsum("nij,nj->ni", across, poses[:, 2, :3]), jacobians)


def displacement_factors(nodes: Sequence[Keyframe], rig: StereoRig) -> BinaryFactors:
    """Returns the factors of the DVL's displacements between nodes: measured = (1 + s) d + noise."""
    # d: displacement of the body's origin in the body axes at the earlier node, which is in `nodes`; s: scale error of
    # the DVL, the first of the shared parameters
    index_of = {node.number: k for k, node in enumerate(nodes)}
    with_dvl = [(k, node.dvl_displacement) for k, node in enumerate(nodes) if node.dvl_displacement is not None]
    pairs = [(index_of[d.since], k, d) for k, d in with_dvl if d.since in index_of]
    i, j = (np.array([pair[end] for pair in pairs], np.int64) for end in (0, 1))
    measured_m = np.array([d.displacement_m for _, _, d in pairs]).reshape(-1, 3)
    information = symmetric_inverses(np.array([d.cov for _, _, d in pairs]).reshape(-1, 3, 3))

    def residuals(i_from_j: Array, shared: Array) -> Array:
        return (1 + shared[0]) * _body_displacements(i_from_j, rig.body_from_camera)[0] - measured_m

    def jacobians(i_from_j: Array, shared: Array, _: Array) -> Array:
        return (1 + shared[0]) * _body_displacements(i_from_j, rig.body_from_camera)[1]

    def by_shared(i_from_j: Array, _: slice, n_shared: int) -> Array:
        derivatives = np.zeros((len(i_from_j), 3, n_shared))
        derivatives[:, :, 0] = _body_displacements(i_from_j, rig.body_from_camera)[0]
        return derivatives

    return BinaryFactors(i, j, information, residuals, jacobians, by_shared=by_shared)


@kernel
def _body_displacements(motions, body_from_camera):
    displacements, by_motion = np.empty((len(motions), 3)), np.empty((len(motions), 3, 6))
    for k in range(len(motions)):
        displacement, jacobian = body_displacement(motions[k], body_from_camera)
        geometry.copy_into(displacements[k], displacement)
        geometry.copy_into(by_motion[k], jacobian)
    return displacements, by_motion
