"""From what witnesses noted on rendered surveys to the error model: every claim and every error is matched in turn."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from scipy.optimize import least_squares, nnls

from twin.surrogate.error_model import ErrorModel, Law, Share
from twin.surrogate_fit.witness import RELIEF, STEADY

_LINK_PARTS = ("images", "patches", "relief")
_THIRDS_ERR = 0.1  # of the squared errors of a third of a survey's links, relative

Notes = Mapping[str, Sequence[float]]


def fitted(surveys: Sequence[Notes], model: ErrorModel) -> ErrorModel:
    """The model that would have answered these surveys as the images did; `model` is the one that was compared.

    Deviations are matched by the medians of ratios, excesses by those of squared errors in their own claims, so that a
    few failures do not rule; each survey counts the same.
    """
    bounds = np.array([np.median(s["bound_px"]) for s in surveys])

    def ratio(name: str) -> np.ndarray:
        return np.array([np.median(s[name]) for s in surveys])

    frames_err = np.sqrt(ratio("f2f_nees") / ratio("f2f_nees_surrogate"))
    place_px = ratio("place_ratio") * [model.place_px(b) for b in bounds]
    place = _law(bounds, place_px)
    f2f = _law(bounds, ratio("f2f_claim") * [model.f2f_px(b) for b in bounds])
    mosaic = _law(bounds, ratio("mosaic_claim") * [model.mosaic_px(b) for b in bounds])
    apart, link_claims = _apart(surveys, model.apart)
    widened = float(np.median(link_claims / ratio("place_ratio")))
    patches, relief, steady = _link_parts(surveys, model.relief)
    place_excess, lamps = _by_lamps(patches / ratio("place_ratio"), ratio("lamp_share"))
    depth, lateral = (np.sqrt(x) for x in zip(*(_map_parts(s, "") for s in surveys), strict=True))
    claimed = [np.sqrt(_map_parts(s, "_claimed")[0]) for s in surveys]
    depth_px = [model.depth_px(b) * share for b, share in zip(bounds, claimed, strict=True)]
    in_claims = ratio("mosaic_difference") - model.mosaic_excess**2
    return model._replace(
        bound_px=(float(bounds.min()), float(bounds.max())),
        points=_share(bounds, ratio("points")),
        place_px=place,
        place_excess=place_excess,
        lamps=lamps,
        matched=_share(bounds, np.minimum(ratio("link_matched") * [model.matched(b) for b in bounds], 1.0)),
        correlation=model.correlation * widened**2,
        steady=steady,
        apart=apart,
        relief=relief,
        f2f_px=f2f,
        f2f_excess=model.f2f_excess * float(np.median(frames_err)),
        f2f_undone=float(np.median([_undone(s) for s in surveys])),
        mosaic_px=mosaic,
        depth_px=_law(bounds, np.array(depth_px)),
        depth_excess=model.depth_excess * float(np.median(depth / claimed)),
        lateral_px=model.lateral_px * float(np.sqrt(np.mean(lateral**2))),
        complete=_share(bounds, ratio("map_known")),
        mosaic_excess=float(np.sqrt(np.median(np.maximum(in_claims, 0.01) / ratio("mosaic_claim") ** 2))),
    )


def misfit(surveys: Sequence[Notes], compared: ErrorModel, model: ErrorModel) -> dict[str, float]:
    """Root mean square over surveys of the logarithm of each claim over what the model says, by name."""
    names = {"place_px": "place_ratio", "f2f_px": "f2f_claim", "mosaic_px": "mosaic_claim"}
    return {law: _spread(surveys, ratio, getattr(compared, law), getattr(model, law)) for law, ratio in names.items()}


def _spread(surveys: Sequence[Notes], ratio: str, compared: Law, law: Law) -> float:
    bounds = [np.median(s["bound_px"]) for s in surveys]
    logs = [np.log(np.median(s[ratio]) * compared(b) / law(b)) for s, b in zip(surveys, bounds, strict=True)]
    return float(np.sqrt(np.mean(np.square(logs))))


def _law(bounds: np.ndarray, deviations: np.ndarray) -> Law:
    """Least squares of the logarithms."""

    def off(x: np.ndarray) -> np.ndarray:
        return np.log(np.hypot(x[0], x[1] * bounds) / deviations)

    found = least_squares(off, [deviations.min() / 2, 1.0], bounds=([1e-4, 0.0], [10.0, 100.0]))
    return Law(float(found.x[0]), float(found.x[1]))


def _share(bounds: np.ndarray, shares: np.ndarray) -> Share:
    def off(x: np.ndarray) -> np.ndarray:
        return np.array([Share(x[0], np.exp(x[1]), 4.0)(b) for b in bounds]) - shares

    start = [min(float(shares.max()), 0.999), np.log(4 * bounds.max())]
    found = least_squares(off, start, bounds=([0.01, np.log(bounds.min())], [1.0, np.log(100 * bounds.max())]))
    return Share(float(found.x[0]), float(np.exp(found.x[1])), 4.0)


def _undone(notes: Notes) -> float:
    """From by how much less the motion over an interval errs than its n frames would, were they independent.

    Where each undoes the share u of the last one's error, (1 + (n - 1) (1 - u)^2) / (n (1 + u^2)) of it is left.
    """
    n = float(np.median(notes["f2f_frames"]))
    left = np.median(notes["f2f_interval"]) / np.median(notes["f2f_nees"])
    u = np.linspace(-1.0, 1.0, 2001)
    return float(u[np.argmin(np.abs((1 + (n - 1) * (1 - u) ** 2) / (n * (1 + u**2)) - left))])


def _link_parts(surveys: Sequence[Notes], own_relief: float) -> tuple[np.ndarray, float, float]:
    """By how much links err in all: as multiples of what patches (n,) and relief alone do, and what is steady of these.

    Relief's share grows with the way, that of patches does not: within each survey, links are compared by thirds of
    their ways. Over a smooth floor that tells nothing, so that the relief of before counts as well, as known to itself.
    What is steady about a keyframe lets a link of the path undo what the one before it erred by, as it is the earlier
    one of the second and the later one of the first; relief lets it err the same way again. (Links around three
    keyframes tell nothing of it: those from one keyframe err alike.)
    """
    thirds = np.array([_squares_by_way(s) for s in surveys])
    images, by_patches, by_relief = thirds.transpose(2, 0, 1)
    own = max(own_relief / RELIEF, 0.5) ** 2
    effects, wanted = [np.array([_THIRDS_ERR / own])], [np.array([_THIRDS_ERR])]
    for patch, more in zip(by_patches / images, by_relief / images, strict=True):
        left = np.eye(3) - np.outer(patch, patch) / (patch @ patch)  # by patches
        effects.append(left @ more)
        wanted.append(left.sum(axis=1))
    effect = np.concatenate(effects)
    relief = max(float(effect @ np.concatenate(wanted) / (effect @ effect)), 0.0)
    patches = np.median(np.maximum(images - relief * by_relief, images / 10) / by_patches, axis=1)
    chains = np.array([[np.mean(s[f"chain_{name}"]) for name in _LINK_PARTS] for s in surveys])
    steady = STEADY * np.sum((chains[:, 0] - relief * chains[:, 2]) / patches) / np.sum(chains[:, 1])
    return np.sqrt(patches), RELIEF * float(np.sqrt(relief)), float(np.clip(steady, 0.0, 0.98))


def _by_lamps(excess: np.ndarray, lamp_share: np.ndarray) -> tuple[float, float]:
    """True over claimed deviation of patches without lamps, and by how much it grows with their share of the light.

    Least squares of the relative errors of squares.
    """
    effects = np.column_stack([np.ones_like(excess), lamp_share**2]) / excess[:, None] ** 2
    alike, more = nnls(effects, np.ones(len(excess)))[0]
    return float(np.sqrt(alike)), float(np.sqrt(more / max(alike, 1e-6)))


def _squares_by_way(notes: Notes) -> np.ndarray:
    """(3, 3) squared errors of links near, farther and far: of the images, by patches and by relief alone.

    The mean of 19 in 20.
    """
    errors = np.column_stack([notes[f"link_{name}"] for name in _LINK_PARTS])
    thirds = (np.sort(errors[third], axis=0) for third in np.array_split(np.argsort(notes["link_apart"]), 3))
    return np.array([third[: len(third) - len(third) // 20].mean(axis=0) for third in thirds])


def _apart(surveys: Sequence[Notes], own: float) -> tuple[float, np.ndarray]:
    """How fast claims of links grow with the way between their keyframes, and their ratio (n,) at none, by survey.

    One of the two pairs is placed by the match, so that (1 + (apart way)^2 / 2) is what a link's variance grows by.
    """
    ways = [np.square(s["link_apart"]) / 2 for s in surveys]
    claims = [2 * np.log(s["link_claim"]) + np.log1p(own**2 * way) for s, way in zip(surveys, ways, strict=True)]

    def off(x: np.ndarray) -> list[np.ndarray]:
        return [claim - np.log1p(x[0] ** 2 * way) for claim, way in zip(claims, ways, strict=True)]

    def around(x: np.ndarray) -> np.ndarray:
        return np.concatenate([(rest - np.median(rest)) / np.sqrt(len(rest)) for rest in off(x)])

    found = least_squares(around, [max(own, 1.0)], bounds=([0.0], [30.0]), loss="soft_l1", f_scale=0.02).x
    return float(found[0]), np.exp([np.median(rest) / 2 for rest in off(found)])


def _map_parts(notes: Notes, what: str) -> np.ndarray:
    """(2,) by how much the variances by depth and by sideways error have to grow for level and steep cells to agree."""
    names = [name for name in ("level", "steep") if f"map_{name}_images{what}" in notes]
    images, pose, depth, lateral = (
        np.array([notes[f"map_{name}_{whose}{what}"][0] for name in names])
        for whose in ("images", "pose", "depth", "lateral")
    )
    effects = np.stack([depth - pose, lateral - pose], axis=1) / images[:, None]
    return nnls(effects, np.maximum(1 - pose / images, 0))[0]
