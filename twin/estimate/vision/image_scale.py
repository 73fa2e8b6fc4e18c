"""The scale at which images are matched: pixels are binned where the floor's texture is coarser than their noise.

Found over a floor whose texture resolves 7.6 cm (a texel is 12 pixels wide, its contrast twice the noise): of the
corners of the full image 0.35 to 0.6 are found by the other eye, the others are corners of noise, and flow from frame
to frame is lost within 18 s. With pixels binned by 2 or 4 it is 0.88 to 0.96, and the survey flies. Over floors whose
texture the full image resolves it is 0.95 to 0.99 at full size. A larger patch alone keeps the noise's corners.
"""

from __future__ import annotations

from twin.core.records import Image, StereoRig
from twin.estimate.vision import disparity, matching, stereo
from twin.scenario.model import EstimateConfig

_BINNINGS = (1, 2, 4)
_ENOUGH = 2 / 3  # of the corners are texture


def binning(left: Image, right: Image, rig: StereoRig, settings: EstimateConfig) -> int:
    """How many pixels to take as one along either side: the fewest with which most corners are seen by both cameras.

    Args:
        left, right: (height, width, 3) of the first keyframe.
    """
    best, most = 1, 0.0
    for by in _BINNINGS:
        if rig.width_px % by or rig.height_px % by:
            break
        share = _share_found(left, right, by, rig.binned(by), settings)
        if share > _ENOUGH:
            return by
        if share > most:
            best, most = by, share
    return best


def _share_found(left_rgb: Image, right_rgb: Image, by: int, rig: StereoRig, settings: EstimateConfig) -> float:
    """Share of the corners with a rough disparity that are found to a fraction of a pixel."""
    left, right = matching.gray(left_rgb, by), matching.gray(right_rgb, by)
    dense_px = disparity.search(
        matching.normalise(left), matching.normalise(right), disparity.Reach(rig).max_disparity_px
    )
    pixels, _ = stereo.corners_with_disparity(left, dense_px, settings.points, settings.patch_px)
    points = stereo.points_of_pair(left, right, dense_px, rig, settings.points, settings.patch_px)
    return len(points.xyz) / max(len(pixels), 1)
