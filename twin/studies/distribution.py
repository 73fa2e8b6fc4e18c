"""Probability distribution, or list of values, of one varied key of a study."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError
from scipy.special import ndtri

from twin.scenario.model import Number, Section

Array = NDArray[np.float64]
Pair = tuple[Number, Number]
Values = Annotated[tuple[Any, ...], Field(min_length=1)]


class Distribution(Section):
    """Distribution of one varied key; exactly one field is given, and its name is the kind of distribution."""

    uniform: Pair | None = Field(default=None, description="[low, high]")
    log_uniform: Pair | None = Field(default=None, description="[low, high]; the logarithm is uniformly distributed")
    normal: Pair | None = Field(default=None, description="[mean, standard deviation]")
    truncated_normal: tuple[Number, Number, Number, Number] | None = Field(
        default=None, description="[mean, standard deviation, low, high]"
    )
    choice: Values | None = Field(default=None, description="one of these values, with equal probability")
    grid: Values | None = Field(default=None, description="every one of these values, for every sample of other keys")

    @model_validator(mode="before")
    @classmethod
    def _exactly_one_kind(cls, given: Any) -> Any:
        if not isinstance(given, dict) or (len(given) != 1 and not given.keys() - set(KINDS)):
            raise PydanticCustomError(
                "one_kind", "one of {kinds}, e.g. {example}", {"kinds": ", ".join(KINDS), "example": _EXAMPLE}
            )
        return given

    @model_validator(mode="after")
    def _valid_parameters(self) -> Distribution:
        rule = _RULES.get(self.kind)
        if rule is not None and not rule[1](*self.values):
            raise PydanticCustomError("order", rule[0])
        return self

    @property
    def kind(self) -> str:
        """Returns the kind of distribution: the name of the only field that is not None, e.g. "uniform"."""
        return next(name for name in KINDS if getattr(self, name) is not None)

    @property
    def values(self) -> tuple[Any, ...]:
        """Returns the parameters of the distribution, or the listed values of a choice or grid."""
        return getattr(self, self.kind)

    @property
    def is_sampled(self) -> bool:
        """Returns whether the key is sampled; the values of a grid are enumerated instead."""
        return self.kind != "grid"

    def quantiles(self, probability: Array) -> list[Any]:
        """Returns the quantiles at probabilities (n,), 0 to 1; the values of a choice or grid are equally probable."""
        if self.kind in ("choice", "grid"):
            return [self.values[k] for k in equal_bins(probability, len(self.values))]
        return [float(value) for value in _QUANTILES[self.kind](clip_probability(probability), *self.values)]


_EXAMPLE = "{ uniform = [0.5, 2.0] }"
KINDS = tuple(Distribution.model_fields)
_RULES = {
    "uniform": ("low < high", lambda low, high: low < high),
    "log_uniform": ("0 < low < high", lambda low, high: 0 < low < high),
    "normal": ("standard deviation > 0", lambda _, sigma: sigma > 0),
    "truncated_normal": ("standard deviation > 0, low < high", lambda _, sigma, low, high: sigma > 0 and low < high),
}


def _truncated_normal(probability: Array, mean: float, sigma: float, low: float, high: float) -> Array:
    bounds = (low - mean) / sigma, (high - mean) / sigma
    from scipy import stats  # the import takes a second, and workers do not need it

    return np.clip(stats.truncnorm.ppf(probability, *bounds, loc=mean, scale=sigma), low, high)


_QUANTILES = {
    "uniform": lambda p, low, high: low + (high - low) * p,
    "log_uniform": lambda p, low, high: np.exp(np.log(low) + np.log(high / low) * p),
    "normal": lambda p, mean, sigma: mean + sigma * ndtri(p),
    "truncated_normal": _truncated_normal,
}


def clip_probability(probability: Array) -> Array:
    """Returns probabilities clipped to [1e-12, 1 - 1e-12], so that the quantiles of normal distributions are finite."""
    return np.clip(probability, 1e-12, 1 - 1e-12)


def equal_bins(probability: Array, count: int) -> NDArray[np.int64]:
    """Returns the index of the bin that contains each probability, for `count` equal bins of [0, 1]."""
    return np.minimum((probability * count).astype(np.int64), count - 1)
