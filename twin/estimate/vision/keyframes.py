"""A keyframe of a survey: its estimated pose, its matched points and its sensor readings."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import Displacement, Exposure, Readings
from twin.estimate.vision.stereo import StereoPoints


@dataclass
class Keyframe:
    """Frame with a stereo pair whose pose the network estimates ("key point" in Negahdaripour & Madjidi 2003).

    Its fields are updated in place during the survey.
    """

    number: int  #: index of the keyframe, from 0
    row: int  #: index of its frame in the trajectories
    track: int  #: number of its track, from 1
    world_from_camera: Array  #: (4, 4) latest estimate of the pose
    points: StereoPoints | None  #: matched stereo points; None once a newer keyframe has been added
    readings: Readings  #: readings of the navigation sensors
    #: displacement since the previous node, measured by the DVL; None if it was not measured, or if the link to the
    #: previous node is the F2F motion, which already includes the DVL readings.
    dvl_displacement: Displacement | None = None
    #: (6, 6) sum of the covariances of all motions since the start, minus the decreases due to registrations with the
    #: mosaic; in world axes [rotation, translation] (rad, m). The difference between the values of two keyframes is the
    #: covariance of the motion between them.
    accumulated_cov: Array = field(default_factory=lambda: np.zeros((6, 6)))
    depth_m: float = np.nan  #: median depth of the matched points [m]
    exposure: Exposure | None = None  #: exposure of its images; None if it was not reported

    def motion_cov(self, earlier: Keyframe, world_from_camera: Array | None = None) -> Array:
        """Returns the covariance (6, 6) of the motion since an earlier keyframe [rotation, translation] (rad, m).

        It is too large for keyframes that have been aligned globally, because alignments do not decrease
        `accumulated_cov`.

        Args:
            world_from_camera: (4, 4) pose of the camera whose axes are used; by default the pose of this keyframe.
        """
        pose = self.world_from_camera if world_from_camera is None else world_from_camera
        from_world = geometry.adjoint(geometry.inverse(pose))
        return from_world @ (self.accumulated_cov - earlier.accumulated_cov) @ from_world.T
