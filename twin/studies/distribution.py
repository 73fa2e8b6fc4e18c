"""Probability distribution, or list of values, of one varied key of a study."""

from typing import Annotated, Any, Self

import numpy as np
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError
from scipy.special import ndtri

from twin.core.geometry import Array
from twin.scenario.model import Number, Section

Pair = tuple[Number, Number]
Values = Annotated[tuple[Any, ...], Field(min_length=1)]


class Distribution(Section):
    """Distribution of one varied key; exactly one field is given, and its name is the kind of distribution."""

    uniform: Pair | None = None
    """[low, high]"""
    log_uniform: Pair | None = None
    """[low, high]; the logarithm is uniformly distributed"""
    normal: Pair | None = None
    """[mean, standard deviation]"""
    truncated_normal: tuple[Number, Number, Number, Number] | None = None
    """[mean, standard deviation, low, high]"""
    choice: Values | None = None
    """one of these values, with equal probability"""
    grid: Values | None = None
    """every one of these values, for every sample of other keys"""

    @model_validator(mode="before")
    @classmethod
    def _exactly_one_kind(cls, given: Any) -> Any:
        if not isinstance(given, dict) or (len(given) != 1 and not given.keys() - set(KINDS)):
            raise PydanticCustomError(
                "one_kind", "one of {kinds}, e.g. {example}", {"kinds": ", ".join(KINDS), "example": _EXAMPLE}
            )
        return given

    @model_validator(mode="after")
    def _valid_parameters(self) -> Self:
        if self.kind in _LAWS:
            rule, is_valid, _ = _LAWS[self.kind]
            if not is_valid(*self.values):
                raise PydanticCustomError("order", rule)
        return self

    @property
    def kind(self) -> str:
        return next(name for name in KINDS if getattr(self, name) is not None)

    @property
    def values(self) -> tuple[Any, ...]:
        return getattr(self, self.kind)

    @property
    def bounds(self) -> tuple[Any, ...]:
        """Returns low and high, of a normal distribution those of 95 %; the values of a choice or grid."""
        if self.normal is not None:
            return tuple(self.quantiles(np.array([0.025, 0.975])))
        return self.values[-2:] if self.kind in _LAWS else self.values

    @property
    def is_sampled(self) -> bool:
        """Returns whether values are sampled; those of a grid are enumerated instead."""
        return self.kind != "grid"

    def quantiles(self, probability: Array) -> list[Any]:
        """Returns the quantiles at probabilities (n,), 0 to 1; the values of a choice or grid are equally probable."""
        if self.kind not in _LAWS:
            n = len(self.values)
            return [self.values[k] for k in np.minimum((probability * n).astype(np.int64), n - 1)]
        inside = np.clip(probability, 1e-12, 1 - 1e-12)  # where the quantiles of normal distributions are finite
        return [float(value) for value in _LAWS[self.kind][2](inside, *self.values)]


_EXAMPLE = "{ uniform = [0.5, 2.0] }"
KINDS = tuple(Distribution.model_fields)


def _truncated_normal(probability: Array, mean: float, sigma: float, low: float, high: float) -> Array:
    bounds = (low - mean) / sigma, (high - mean) / sigma
    from scipy import stats  # the import takes a second, and workers do not need it

    return np.clip(stats.truncnorm.ppf(probability, *bounds, loc=mean, scale=sigma), low, high)


#: For each continuous distribution: the rule for its parameters, as text and as a function; its quantiles.
_LAWS: dict[str, tuple[Any, Any, Any]] = {
    "uniform": ("low < high", lambda low, high: low < high, lambda p, low, high: low + (high - low) * p),
    "log_uniform": (
        "0 < low < high",
        lambda low, high: 0 < low < high,
        lambda p, low, high: np.exp(np.log(low) + np.log(high / low) * p),
    ),
    "normal": ("standard deviation > 0", lambda _, sigma: sigma > 0, lambda p, mean, sigma: mean + sigma * ndtri(p)),
    "truncated_normal": (
        "standard deviation > 0, low < high",
        lambda _, sigma, low, high: sigma > 0 and low < high,
        _truncated_normal,
    ),
}
