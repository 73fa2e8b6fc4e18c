"""Inspection of the light of recorded stereo images: the pattern that moves with the cameras, and a pair without it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from twin.core.records import Frame, Image, StereoRig
from twin.estimate.first_pair import PairInspection, square_images
from twin.estimate.mapping.map_builder import KeyframeImages, gray_levels
from twin.estimate.mapping.mean_illumination import MeanIllumination
from twin.estimate.vision import disparity
from twin.estimate.vision.disparity import Disparity
from twin.estimate.vision.light_pattern import light_pattern, pattern_fit

Map = NDArray[np.float32]


class LightInspection(NamedTuple):
    """Light of a stereo camera, from n stereo pairs, and a pair whose light was made uniform.

    Lamps, vignetting and backscatter belong to the cameras and stay in the mean of many pairs; the floor averages out.
    """

    n_pairs: int  #: number of pairs n
    #: mean_left, mean_right: (H, W) mean grey levels of the pairs.
    mean_left: Map
    mean_right: Map
    even_left: Image  #: (H, W, 3) left image with the gain that the colours of the map get
    subtracted: bool  #: whether the estimators subtract a light pattern before dense matching (`light_pattern`)
    #: dense disparity of the left image as the map uses it: without the light pattern if it is subtracted.
    disparity: Disparity


def inspect_light(pair: PairInspection, frames: Iterable[Frame], rig: StereoRig) -> LightInspection:
    """Returns the light of the cameras, and what the estimators make of it in one pair.

    Args:
        pair: the pair to show.
        frames: frames with both images in chronological order, best spread over the whole recording; at least one.
        rig: believed calibration of the frames.
    """
    illumination, fits = MeanIllumination(pair.rig), []
    mean = np.zeros((2, pair.rig.height_px, pair.rig.width_px), np.float32)
    for frame in frames:
        images = KeyframeImages(*square_images(frame, rig))
        grays = gray_levels(images)
        mean += np.array(grays)
        fits.append(pattern_fit(grays))
        illumination.add(images.left)
    pattern = light_pattern(fits, mean.shape[1:])
    dense = pair.disparity
    if pattern is not None:
        left, right = gray_levels(KeyframeImages(pair.left, pair.right))
        widest_px = disparity.SearchRange(pair.rig).max_disparity_px
        dense = disparity.dense_disparity(left - pattern.left, right - pattern.right, widest_px)
    even = np.clip(np.round(pair.left * illumination.gain()), 0, 255).astype(np.uint8)
    return LightInspection(len(fits), mean[0] / len(fits), mean[1] / len(fits), even, pattern is not None, dense)
