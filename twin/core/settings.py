"""Settings of the estimators, and the braking of a vehicle without vision, which the mission and they agree on."""

import math
from dataclasses import dataclass, field, fields
from typing import Any

from twin.errors import TwinError

#: A link is rejected if fewer than this fraction of its matched points are inliers of the estimated motion.
MIN_INLIER_SHARE = 0.3
#: Standard deviation of the interpolation bias, an error common to all points of a link [px].
COMMON_BIAS_PX = 0.005
#: After BLIND_S without a measured motion, the vehicle is taken to stop with the time constant BRAKING_S [s].
BLIND_S, BRAKING_S = 0.5, 1.0


def _key(default: Any, description: str, **limits: float) -> Any:
    """Returns a setting that is also a scenario key, with limits in pydantic's terms (ge and le, or gt and lt)."""
    return field(default=default, metadata={"description": description, **limits})


@dataclass(frozen=True)
class EstimatorSettings:
    """Settings of motion estimation, network and global alignment; raises TwinError if one is out of range."""

    window_tracks: int = _key(4, "number of previous tracks in the window of global alignment", ge=0, le=1000)
    node_stride: int = _key(1, "every n-th keyframe is a node of the network", ge=1, le=20)
    min_overlap: float = _key(
        0.45, "smallest overlap of linked nodes, the fraction of a node's matched points that both images show; "
        "consecutive nodes are linked at any overlap", gt=0, lt=1,
    )  # fmt: skip
    max_links: int = _key(7, "largest number of links from a node to earlier nodes", ge=1, le=50)
    use_f2m: bool = _key(True, "register keyframes with the mosaic to correct the position")
    use_ga: bool = _key(True, "global alignment at the end of each track and of the survey")
    points: int = _key(500, "largest number of matched points of a keyframe", ge=30, le=5000)
    #: Patches have an odd side: for an even value, it is one pixel larger.
    patch_px: int = _key(11, "side of the matching window, the same for stereo and optical flow [px]", ge=7, le=61)
    #: a stereo pair becomes a keyframe if the overlap of the next pair with the last keyframe is expected to be below
    #: this fraction, or if tracking has failed; used only if the caller does not choose the keyframes.
    keyframe_overlap: float = field(default=0.9, metadata={"gt": 0, "lt": 1})
    #: whether features are matched over the whole images wherever a link cannot be measured from the predicted poses;
    #: for large or unpredictable motions between keyframes. It costs time only where links fail. Otherwise only where
    #: the covariance of the predicted poses, with which a link must then agree, exceeds the search range.
    wide_search: bool = False
    #: whether the images have noise, so that no image of a live camera equals the image before it.
    noisy_images: bool = True
    #: whether the vehicle stops while no motion is measured (`braking_factor`).
    stops_if_blind: bool = True

    def __post_init__(self) -> None:
        for setting in fields(self):
            value, limits = getattr(self, setting.name), setting.metadata
            allowed = None
            if "le" in limits and not limits["ge"] <= value <= limits["le"]:
                allowed = f"{limits['ge']} to {limits['le']}"
            if "lt" in limits and not limits["gt"] < value < limits["lt"]:
                allowed = f"between {limits['gt']} and {limits['lt']}"
            if allowed:
                raise TwinError(f"estimate.{setting.name}", f"{value!r} is out of range", allowed)


def braking_factor(blind_s: float, interval_s: float, stops: bool = True) -> float:
    """Returns the factor of the speed over an interval that starts after `blind_s` without measured motion."""
    return 1.0 if blind_s <= BLIND_S or not stops else math.exp(-interval_s / BRAKING_S)
