"""What the navigation sensors tell of the nodes (P17), as terms of the alignment's graph.

Pressure, acoustic fixes and the AHRS tell of one node each. Beacons stand where they were surveyed, and the nodes that
see them are resected from their pixels. The DVL tells of pairs of nodes; its scale error is one unknown of the graph:
taken as noise of each pair, it would average out along a path where in truth it adds up.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.links import inverses
from twin.core.records import SensorNoise, StereoRig
from twin.estimate.adjustment.pose_graph import Pairs, Single, errors, log_derivatives
from twin.estimate.navigation import pose_filter
from twin.estimate.navigation.dvl import body_displacement
from twin.estimate.vision.keyframes import Keyframe


def singles(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> list[Single]:
    """What readings tell of one node each, by the nodes' places in their sequence."""
    return [_heights(nodes, noise), _attitudes(nodes, rig, noise), _fixes(nodes, noise), _beacons(nodes, rig, noise)]


def _heights(nodes: Sequence[Keyframe], noise: SensorNoise) -> Single:
    told = [k for k, node in enumerate(nodes) if node.readings.pressure_z_m is not None]
    height_m = np.array([nodes[k].readings.pressure_z_m for k in told], dtype=np.float64)

    def derive(poses: Array, _: Array) -> Array:
        by_pose = np.zeros((len(poses), 1, 6))
        by_pose[:, 0, 3:] = poses[:, 2, :3]
        return by_pose

    information = np.full((len(told), 1, 1), noise.pressure_m**-2)
    return Single(np.array(told, np.int64), information, lambda poses: poses[:, 2, 3:] - height_m[:, None], derive)


def _attitudes(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> Single:
    told = [k for k, node in enumerate(nodes) if node.readings.ahrs_rpy_rad is not None]
    angles = np.array([nodes[k].readings.ahrs_rpy_rad for k in told]).reshape(-1, 3)
    camera_from_body = geometry.inverse(rig.body_from_camera)
    cov = pose_filter.attitude(np.zeros(3), camera_from_body, noise)[1]  # the same for every reading
    measured = _turned(angles, rig.body_from_camera)

    def observe(poses: Array) -> Array:
        turned = poses.copy()
        turned[:, :3, 3] = 0.0
        return errors(measured, turned)[:, :3]

    def derive(_: Array, residuals: Array) -> Array:
        return log_derivatives(np.column_stack([residuals, np.zeros_like(residuals)]))[:, :3]

    return Single(np.array(told, np.int64), np.tile(inverses(cov[None]), (len(told), 1, 1)), observe, derive)


@njit(cache=True, nogil=True)
def _turned(angles, body_from_camera):
    """(m, 4, 4) world_from_camera of attitudes (m, 3) of the body, at the world's origin."""
    poses, at_origin = np.empty((len(angles), 4, 4)), body_from_camera.copy()
    at_origin[:3, 3] = 0.0
    for k in range(len(angles)):
        body = geometry.pose(geometry.rotation_from_rpy(angles[k, 0], angles[k, 1], angles[k, 2]), np.zeros(3))
        geometry.put(poses[k], geometry.compose(body, at_origin))
    return poses


def _fixes(nodes: Sequence[Keyframe], noise: SensorNoise) -> Single:
    told = [k for k, node in enumerate(nodes) if node.readings.usbl_m is not None]
    position_m = np.array([nodes[k].readings.usbl_m for k in told]).reshape(-1, 3)

    def derive(poses: Array, _: Array) -> Array:
        by_pose = np.zeros((len(poses), 3, 6))
        by_pose[:, :, 3:] = poses[:, :3, :3]
        return by_pose

    information = np.tile(np.eye(3) * noise.usbl_m**-2, (len(told), 1, 1))
    return Single(np.array(told, np.int64), information, lambda poses: poses[:, :3, 3] - position_m, derive)


def _beacons(nodes: Sequence[Keyframe], rig: StereoRig, noise: SensorNoise) -> Single:
    sightings = [(k, sighting) for k, node in enumerate(nodes) for sighting in node.readings.beacons or ()]
    beacon_m = np.array([noise.beacons_m[sighting.beacon] for _, sighting in sightings]).reshape(-1, 3)
    pixels = np.array([sighting.pixel for _, sighting in sightings]).reshape(-1, 2)

    def seen(poses: Array) -> tuple[Array, Array]:
        residuals, by_pose = np.zeros((len(poses), 2)), np.zeros((len(poses), 2, 6))
        for k, pose in enumerate(poses):
            expected, jacobian = pose_filter.sight(pose, beacon_m[k], rig)
            if np.isfinite(expected).all():  # one behind the camera says nothing
                residuals[k], by_pose[k] = expected - pixels[k], jacobian
        return residuals, by_pose

    at = np.array([k for k, _ in sightings], np.int64)
    information = np.tile(np.eye(2) * noise.beacon_px**-2, (len(at), 1, 1))
    return Single(at, information, lambda poses: seen(poses)[0], lambda poses, _: seen(poses)[1])


def displacements(nodes: Sequence[Keyframe], rig: StereoRig) -> Pairs:
    """What the log tells of the way d of the body's origin from node to node: (1 + s) d = measured; s is shared."""
    places = {node.number: k for k, node in enumerate(nodes)}
    walked = [(k, node.walked) for k, node in enumerate(nodes) if node.walked and node.walked.since in places]
    i = np.array([places[way.since] for _, way in walked], np.int64)
    metres = np.array([way.metres for _, way in walked]).reshape(-1, 3)
    information = inverses(np.array([way.cov for _, way in walked]).reshape(-1, 3, 3))

    def observe(i_from_j: Array, scale: float) -> Array:
        return (1 + scale) * _ways(i_from_j, rig.body_from_camera)[0] - metres

    def derive(i_from_j: Array, scale: float, _: Array) -> tuple[Array, Array]:
        ways, by_j = _ways(i_from_j, rig.body_from_camera)
        return (1 + scale) * by_j, ways

    return Pairs(i, np.array([k for k, _ in walked], np.int64), information, observe, derive)


@njit(cache=True, nogil=True)
def _ways(motions, body_from_camera):
    """`body_displacement` of many."""
    ways, by_motion = np.empty((len(motions), 3)), np.empty((len(motions), 3, 6))
    for k in range(len(motions)):
        way, derivative = body_displacement(motions[k], body_from_camera)
        geometry.put(ways[k], way)
        geometry.put(by_motion[k], derivative)
    return ways, by_motion
