"""What the navigation sensors tell of the nodes (P17), as factors of the alignment's graph.

Pressure, acoustic fixes and the AHRS tell of one node each. Beacons stand where they were surveyed, and the nodes that
see them are resected from their pixels. The DVL tells of pairs of nodes; its scale error is one unknown of the graph:
taken as noise of each pair, it would average out along a path where in truth it adds up.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from twin import geometry
from twin.estimate import pose_filter
from twin.estimate.key_points import KeyPoint
from twin.estimate.pose_graph import gaussian
from twin.estimate.velocity_log import Displacement, body_displacement
from twin.geometry import Array
from twin.records import SensorNoise, StereoRig

_FREE_M = 1e3  # standard deviation that leaves a coordinate free
_SURVEYED_M = 1e-4  # standard deviation that holds a beacon
_SCALE = gtsam.symbol("s", 0)


def add_readings(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    nodes: Sequence[KeyPoint],
    rig: StereoRig,
    noise: SensorNoise,
    known: dict[int, gtsam.NonlinearFactorGraph],
) -> None:
    """Adds a factor for each reading of the nodes, and the beacons and the scale error that they tell of.

    Args:
        known: what readings tell of one node each, by its number; that of new ones is added.
    """
    camera_from_body = geometry.inverse(rig.body_from_camera)
    height = gtsam.noiseModel.Diagonal.Sigmas(np.array([_FREE_M, _FREE_M, noise.pressure_m]))
    attitude = gaussian(pose_filter.attitude(np.zeros(3), camera_from_body, noise)[1])  # the same for every reading
    for node in nodes:
        if node.number not in known:
            alone = known[node.number] = gtsam.NonlinearFactorGraph()
            _add_height(alone, node, height)
            _add_attitude(alone, node, camera_from_body, noise, attitude)
            _add_fix(alone, node, noise)
        graph.push_back(known[node.number])
    _add_beacons(graph, start, nodes, rig, noise)
    _add_displacements(graph, start, nodes, rig, noise)


def _add_height(graph: gtsam.NonlinearFactorGraph, node: KeyPoint, model: gtsam.noiseModel.Diagonal) -> None:
    if node.readings.pressure_z_m is not None:
        position = node.world_from_camera[:3, 3].copy()
        position[2] = node.readings.pressure_z_m
        graph.add(gtsam.GPSFactor(node.number, position, model))


def _add_attitude(
    graph: gtsam.NonlinearFactorGraph,
    node: KeyPoint,
    camera_from_body: Array,
    noise: SensorNoise,
    model: gtsam.noiseModel.Gaussian,
) -> None:
    if node.readings.ahrs_rpy_rad is not None:
        rotation, _ = pose_filter.attitude(node.readings.ahrs_rpy_rad, camera_from_body, noise)
        graph.add(gtsam.PoseRotationPrior3D(node.number, gtsam.Rot3(rotation), model))


def _add_fix(graph: gtsam.NonlinearFactorGraph, node: KeyPoint, noise: SensorNoise) -> None:
    if node.readings.usbl_m is not None:
        graph.add(gtsam.GPSFactor(node.number, node.readings.usbl_m, gtsam.noiseModel.Isotropic.Sigma(3, noise.usbl_m)))


def _add_beacons(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    nodes: Sequence[KeyPoint],
    rig: StereoRig,
    noise: SensorNoise,
) -> None:
    camera = gtsam.Cal3_S2(rig.focal_px, rig.focal_px, 0.0, rig.cx_px, rig.cy_px)
    pixel_noise = gtsam.noiseModel.Isotropic.Sigma(2, noise.beacon_px)
    sightings = [(node, sighting) for node in nodes for sighting in node.readings.beacons or ()]
    for node, (beacon, pixel) in sightings:
        key = gtsam.symbol("b", beacon)
        graph.add(gtsam.GenericProjectionFactorCal3_S2(np.array(pixel), pixel_noise, node.number, key, camera))
    for beacon in sorted({sighting.beacon for _, sighting in sightings}):
        key, position = gtsam.symbol("b", beacon), np.array(noise.beacons_m[beacon])
        start.insert(key, position)
        graph.add(gtsam.PriorFactorPoint3(key, position, gtsam.noiseModel.Isotropic.Sigma(3, _SURVEYED_M)))


def _add_displacements(
    graph: gtsam.NonlinearFactorGraph,
    start: gtsam.Values,
    nodes: Sequence[KeyPoint],
    rig: StereoRig,
    noise: SensorNoise,
) -> None:
    numbers = {node.number for node in nodes}
    pairs = [(node, node.walked) for node in nodes if node.walked is not None and node.walked.since in numbers]
    if not pairs:
        return
    start.insert(_SCALE, np.zeros(1))
    graph.add(gtsam.PriorFactorVector(_SCALE, np.zeros(1), gtsam.noiseModel.Isotropic.Sigma(1, noise.dvl_scale)))
    for node, walked in pairs:
        graph.add(_displacement_factor(node.number, walked, start, rig.body_from_camera))


def _displacement_factor(
    number: int, walked: Displacement, start: gtsam.Values, body_from_camera: Array
) -> gtsam.LinearContainerFactor:
    """Error (1 + s) d(a_from_b) - measured, of the way d of the body's origin from node a to node b = `number`.

    Linear about the start: a common move of both nodes changes nothing, and of their relative correction only the
    square is left out, 1e-6 of the way for 1 mrad. gtsam has no such factor, and one in Python copies all values at
    each call.
    """
    a_from_b = start.atPose3(walked.since).between(start.atPose3(number)).matrix()
    way, by_b = body_displacement(a_from_b, body_from_camera)
    by_a = -by_b @ geometry.adjoint(geometry.inverse(a_from_b))  # moving a by m moves b in a by -Ad(b_from_a) m
    whiten = np.linalg.inv(np.linalg.cholesky(walked.cov))
    linear = gtsam.JacobianFactor(
        walked.since, whiten @ by_a, number, whiten @ by_b, _SCALE, whiten @ way[:, None],
        whiten @ (walked.metres - way), gtsam.noiseModel.Unit.Create(3),
    )  # fmt: skip
    return gtsam.LinearContainerFactor(linear, start)
