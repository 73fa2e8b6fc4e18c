"""Number of images that show the points of a surface, without occlusions."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.geometry import Array
from twin.core.records import StereoRig
from twin.kernels import kernel

NOT_SHOWN = -1  #: `ImageCoverage.first` of a point that no image shows


class ImageCoverage(NamedTuple):
    """Coverage of n points by images."""

    n_images: NDArray[np.int64]  #: (n,) number of images that show the point
    first: NDArray[np.int64]  #: (n,) index of the first of these images; `NOT_SHOWN` without one
    height_m: Array  #: (n,) mean height of these images above the point; NaN without one


def image_coverage(points: Array, world_from_camera: Array, rig: StereoRig, baseline_m: float) -> ImageCoverage:
    """Returns the coverage of points (n, 3) in the world [m] by images at poses (k, 4, 4).

    An image shows a point that lies within it and within a second image, at `baseline_m` along the x axis of the first.
    """
    corners = rig.normalised(np.array([[-0.5, -0.5], [rig.width_px - 0.5, rig.height_px - 0.5]]))
    count, first, total_m = np.zeros(len(points), np.int64), np.full(len(points), NOT_SHOWN), np.zeros(len(points))
    poses = np.ascontiguousarray(world_from_camera, np.float64)
    _count(np.ascontiguousarray(points, np.float64), poses, corners, baseline_m, count, first, total_m)
    return ImageCoverage(count, first, np.divide(total_m, count, out=np.full(len(points), np.nan), where=count > 0))


@kernel(allocates=False)
def _count(points, poses, corners, baseline_m, count, first, total_m):
    left, top, right, bottom = corners[0, 0], corners[0, 1], corners[1, 0], corners[1, 1]
    for k in range(len(poses)):
        pose = poses[k]
        for i in range(len(points)):
            dx, dy, dz = points[i, 0] - pose[0, 3], points[i, 1] - pose[1, 3], points[i, 2] - pose[2, 3]
            z = dx * pose[0, 2] + dy * pose[1, 2] + dz * pose[2, 2]
            x = dx * pose[0, 0] + dy * pose[1, 0] + dz * pose[2, 0]
            y = dx * pose[0, 1] + dy * pose[1, 1] + dz * pose[2, 1]
            if z > 0 and left * z <= x - baseline_m and x <= right * z and top * z <= y <= bottom * z:
                if count[i] == 0:
                    first[i] = k
                count[i] += 1
                total_m[i] -= dz
