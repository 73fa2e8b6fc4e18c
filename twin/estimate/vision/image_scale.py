"""Choice of the image scale: pixels are binned if texture is so coarse that many of the detected corners are noise.

Over texels of 12 pixels, 35 to 60 % of the corners are matched at full size, 88 to 96 % with binning by 2 or 4; over
fine texture 95 to 99 % without. Larger patches alone do not help.
"""

from __future__ import annotations

from twin.core.records import Image, StereoRig
from twin.core.settings import EstimatorSettings
from twin.estimate.vision import disparity, matching, stereo

BINNINGS = (1, 2, 4)  #: numbers of pixels that may be averaged along each side
_MIN_MATCHED = 2 / 3  # smallest sufficient fraction of matched corners


def choose_binning(left: Image, right: Image, rig: StereoRig, settings: EstimatorSettings) -> int:
    """Returns the smallest binning [px] at which over two thirds of the corners are matched, else that with the most.

    Only binnings that divide the width and the height of the images are tried.

    Args:
        left, right: (height, width, 3) images of a stereo pair.
    """
    best, best_fraction = 1, 0.0
    for binning in BINNINGS:
        if rig.width_px % binning or rig.height_px % binning:
            break
        fraction = _matched_fraction(left, right, binning, rig.binned(binning), settings)
        if fraction > _MIN_MATCHED:
            return binning
        if fraction > best_fraction:
            best, best_fraction = binning, fraction
    return best


def _matched_fraction(
    left_rgb: Image, right_rgb: Image, binning: int, rig: StereoRig, settings: EstimatorSettings
) -> float:
    """Returns the fraction of the corners with known disparity that `stereo.match_stereo_points` also matches."""
    left, right = matching.gray(left_rgb, binning), matching.gray(right_rgb, binning)
    max_disparity_px = disparity.SearchRange(rig).max_disparity_px
    dense_px = disparity.search(matching.normalise(left), matching.normalise(right), max_disparity_px)
    pixels, _ = stereo.corners_with_disparity(left, dense_px, settings.points, settings.patch_px)
    points = stereo.match_stereo_points(left, right, dense_px, rig, settings.points, settings.patch_px)
    return len(points.xyz) / max(len(pixels), 1)
