"""Settings of the estimators."""

from __future__ import annotations

from dataclasses import dataclass

from twin.errors import TwinError

#: A link is rejected if fewer than this fraction of its matched points are inliers of the estimated motion.
MIN_INLIER_SHARE = 0.3
#: Standard deviation of the interpolation bias, an error common to all points of a link [px].
COMMON_BIAS_PX = 0.005


@dataclass(frozen=True)
class EstimatorSettings:
    """Settings of motion estimation, the keyframe network and global alignment.

    Raises:
        TwinError: a value is out of range.
    """

    #: number of previous tracks that the global alignment at the end of a track adjusts, in addition to this track.
    window_tracks: int = 4
    node_stride: int = 1  #: every n-th keyframe is a node of the network
    #: smallest predicted overlap for a link from a node to an earlier one: the fraction of the node's matched points
    #: that project into the earlier image. The link to the previous node is measured at any overlap.
    min_overlap: float = 0.45
    #: largest number of links from a node to earlier nodes with an overlap of at least `min_overlap`.
    max_links: int = 7
    use_f2m: bool = True  #: whether to register keyframes with the mosaic (F2M)
    use_ga: bool = True  #: whether to align the network globally (GA) at the end of each track and of the survey
    points: int = 500  #: largest number of matched points of a keyframe
    #: side of the matching window, the same for stereo and for motion [px]. Patches have an odd side: for an even
    #: value, it is one pixel larger.
    patch_px: int = 11
    #: a stereo pair becomes a keyframe if the overlap of the next pair with the last keyframe is expected to be below
    #: this fraction, or if tracking has failed; used only if the caller does not choose the keyframes.
    keyframe_overlap: float = 0.9
    #: whether features are matched over the whole images wherever a link cannot be measured from the predicted poses;
    #: for large or unpredictable motions between keyframes. It costs time only where links fail. Otherwise this is done
    #: only where the covariance of the predicted poses exceeds the search range, and a link must agree with this
    #: covariance.
    wide_search: bool = False
    #: whether the images have noise, so that no image of a live camera equals the image before it.
    noisy_images: bool = True

    def __post_init__(self) -> None:
        for name, low, high in (
            ("window_tracks", 0, 1000), ("node_stride", 1, 20), ("max_links", 1, 50), ("points", 30, 5000),
            ("patch_px", 7, 61),
        ):  # fmt: skip
            if not low <= getattr(self, name) <= high:
                raise TwinError(f"estimate.{name}", f"{getattr(self, name)!r} is out of range", f"{low} to {high}")
        for name in ("min_overlap", "keyframe_overlap"):
            if not 0 < getattr(self, name) < 1:
                raise TwinError(f"estimate.{name}", f"{getattr(self, name)!r} is out of range", "between 0 and 1")
