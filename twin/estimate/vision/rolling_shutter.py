"""Points of images whose rows are exposed one after the other, as if all were exposed at mid-exposure."""

import numpy as np

from twin.core.geometry import Array
from twin.core.records import StereoRig


def at_mid_exposure(points: Array, twist: Array | None, rig: StereoRig) -> Array:
    """Returns normalised (x, y, disparity) (n, 3) where a global shutter would show the points."""
    # row v of h is exposed at t = readout (v / (h - 1) - 1/2) after mid-exposure, when a camera with a twist (6,)
    # [rad/s, m/s] in its own axes has moved by exp(t twist), to first order in t
    if not rig.readout_s or twist is None or not len(points):
        return points
    time_s = rig.readout_s * ((points[:, 1] * rig.fy_px + rig.cy_px) / (rig.height_px - 1) - 0.5)
    xyz = np.column_stack([points[:, :2], np.ones(len(points))]) * (rig.baseline_m / points[:, 2:])
    xyz = xyz + (np.cross(twist[:3], xyz) + twist[3:]) * time_s[:, None]
    return np.column_stack([xyz[:, :2] / xyz[:, 2:], rig.baseline_m / xyz[:, 2]])
