"""Interfaces of plug-ins: arguments and results of a controller, an estimator and a terrain of another package."""

from typing import NamedTuple, Protocol

from twin.controllers.allocation import ThrustAllocation
from twin.controllers.segments import Reference
from twin.controllers.tracking import HullModel
from twin.core.geometry import Array
from twin.core.records import Estimate, Frame, Readings, SensorNoise, StereoRig

MOST_OFFSET_M, LEAST_PACE = 0.5, 0.1  #: limits of an `Adaptation`


class ControllerSetup(NamedTuple):
    """Argument with which the class of a controller is called: calibration, and published parameters of the vehicle.

    The factors of the scenario on drag and added mass, which change the true vehicle, are not applied.

    Args:
        rig: believed calibration; `rig.body_from_camera` is the pose of the left camera in the body.
        period_s: time between commands, which is that between frames [s].
        hull: inertia, added mass and drag of the vehicle.
        allocation: thrust allocation of the vehicle; `allocation.commands(wrench)[0]` are the thruster commands (n,)
            for a wrench (6,) [moment, force] in the body [N m, N].
        n_commands: length of a command: n, one per thruster; 3 for vehicle.dynamics = "kinematic".
    """

    rig: StereoRig
    period_s: float
    hull: HullModel
    allocation: ThrustAllocation
    n_commands: int


class Controller(Protocol):
    """Controller (key `control.plugin`, entry points `twin.controllers`), created with a `ControllerSetup`.

    It may have a method `adapt(situation: Situation) -> Adaptation | None`, called at each keyframe after `command`.
    """

    def command(self, estimate: Estimate, reference: Reference) -> Array:
        """Returns the command that applies until the next frame.

        Args:
            estimate: online estimate of the pose and the velocity of the left camera. If neither the images nor the DVL
                measured a motion at this frame, position and velocity are those of the reference, except the height
                and its rate if the pressure sensor has a reading.
            reference: planned position, velocity, yaw and acceleration of the left camera in the world, for this frame.

        Returns:
            Thruster commands (n,), which the thrusters limit to [-1, 1]. For vehicle.dynamics = "kinematic" the
            velocity (3,) in the world [m/s].
        """
        ...


class Situation(NamedTuple):
    """What a controller knows at a keyframe; no truth."""

    time_s: float  #: time since the start
    estimate: Estimate  #: online estimate of the pose and the velocity of the left camera
    readings: Readings  #: readings of the navigation sensors that have arrived
    reference: Reference  #: as the argument of `Controller.command`
    floor_m: Array  #: (n, 3) floor so far, at the online poses: x, y and mean height of cells with points or echoes


class Adaptation(NamedTuple):
    """What a controller changes of the path from a keyframe on, within limits."""

    #: (3,) offset from the planned path in the world [m], up to `MOST_OFFSET_M` horizontally and vertically, towards
    #: which the path moves by at most 0.1 m per keyframe and 0.1 m/s
    offset_m: Array
    pace: float = 1.0  #: factor of the planned speed, `LEAST_PACE` to 1; a vehicle that flies arcs keeps its speed


class EstimatorSetup(NamedTuple):
    """Constructor argument of an estimator plug-in: calibration, start pose and sensor noise as believed; no truth.

    Args:
        rig: believed calibration of the rectified images.
        start: (4, 4) pose world_from_camera of the left camera at the first frame, planned or assumed (replay).
        noise: believed noise of the navigation sensors.
    """

    rig: StereoRig
    start: Array
    noise: SensorNoise


class Estimator(Protocol):
    """Estimator of the trajectory: key `estimate.plugin`, entry points `twin.estimators`.

    The class is called once per survey or replay with an `EstimatorSetup`. Poses are rigid, world_from_camera (4, 4) of
    the left camera. The twin builds the elevation map along the final trajectory from the stereo pairs of the
    keyframes.
    """

    def update(self, frame: Frame) -> Array | None:
        """Returns the online pose (4, 4) at a frame, or None if it could not be measured.

        The right image is None between keyframes. The vehicle slows down if many frames have no pose, and stops if half
        a second has none (`MissionActions`).
        """
        ...

    def covariance(self) -> Array | None:
        """Returns the covariance (6, 6) of the last pose, or None if it is unknown.

        Errors are motions [rotation, translation] (rad, m) in the axes of the camera. With None, sigma of the map
        contains the noise of stereo only, and the consistency of the positions is not judged.
        """
        ...

    def finish(self) -> Array | None:
        """Returns the final poses (n, 4, 4) of all n frames; None if they are the online poses."""
        ...


class TerrainGenerator(Protocol):
    """Generator of floor heights: key `terrain.plugin`, entry points `twin.terrains`; created without arguments."""

    def heights(self, x_m: Array, y_m: Array, seed: int) -> Array:
        """Returns the heights (rows, cols) of the floor above the reference plane z = 0 [m].

        Args:
            x_m: (cols,) x of the grid nodes, ascending [m].
            y_m: (rows,) y of the grid nodes, ascending [m].
            seed: seed of the scenario; the same seed must give the same floor.
        """
        ...
