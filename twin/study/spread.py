"""How a key is spread: a distribution, or values to choose from, as a function of a number between 0 and 1."""

from __future__ import annotations

from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError
from scipy.special import ndtri

from twin.scenario.model import Section

Array = NDArray[np.float64]
Pair = tuple[float, float]
Values = Annotated[tuple[Any, ...], Field(min_length=1)]


class Spread(Section):
    """The values of one key: exactly one of these."""

    uniform: Pair | None = Field(default=None, description="[low, high]")
    log_uniform: Pair | None = Field(default=None, description="[low, high], each decade as often as any other")
    normal: Pair | None = Field(default=None, description="[mean, standard deviation]")
    truncated_normal: tuple[float, float, float, float] | None = Field(
        default=None, description="[mean, standard deviation, low, high]"
    )
    choice: Values | None = Field(default=None, description="one of these, each as often as any other")
    grid: Values | None = Field(default=None, description="each of these with everything else")

    @model_validator(mode="before")
    @classmethod
    def _one_kind(cls, given: Any) -> Any:
        if not isinstance(given, dict) or (len(given) != 1 and not given.keys() - set(KINDS)):
            raise PydanticCustomError(
                "one_kind", "one of {kinds}, as {example}", {"kinds": ", ".join(KINDS), "example": _EXAMPLE}
            )
        return given

    @model_validator(mode="after")
    def _in_order(self) -> Spread:
        rule = _RULES.get(self.kind)
        if rule is not None and not rule[1](*self.values):
            raise PydanticCustomError("order", rule[0])
        return self

    @property
    def kind(self) -> str:
        """Name of the distribution."""
        return next(name for name in KINDS if getattr(self, name) is not None)

    @property
    def values(self) -> tuple[Any, ...]:
        """Its parameters, or the values to choose from."""
        return getattr(self, self.kind)

    @property
    def is_drawn(self) -> bool:
        """Whether a number is drawn for it in every sample; a grid is gone through."""
        return self.kind != "grid"

    def at(self, share: Array) -> list[Any]:
        """The values below which these shares (0 to 1) lie: the inverse of the cumulative distribution."""
        if self.kind in ("choice", "grid"):
            return [self.values[k] for k in equal_parts(share, len(self.values))]
        return [float(value) for value in _QUANTILES[self.kind](inner(share), *self.values)]


_EXAMPLE = "{ uniform = [0.5, 2.0] }"
KINDS = tuple(Spread.model_fields)
_RULES = {
    "uniform": ("low below high", lambda low, high: low < high),
    "log_uniform": ("above 0, low below high", lambda low, high: 0 < low < high),
    "normal": ("a standard deviation above 0", lambda _, deviation: deviation > 0),
    "truncated_normal": (
        "a standard deviation above 0, low below high",
        lambda _, deviation, low, high: deviation > 0 and low < high,
    ),
}


def _truncated_normal(share: Array, mean: float, deviation: float, low: float, high: float) -> Array:
    ends = (low - mean) / deviation, (high - mean) / deviation
    from scipy import stats  # takes a second, and workers never need it

    return np.clip(stats.truncnorm.ppf(share, *ends, loc=mean, scale=deviation), low, high)


_QUANTILES = {
    "uniform": lambda share, low, high: low + (high - low) * share,
    "log_uniform": lambda share, low, high: np.exp(np.log(low) + np.log(high / low) * share),
    "normal": lambda share, mean, deviation: mean + deviation * ndtri(share),
    "truncated_normal": _truncated_normal,
}


def inner(share: Array) -> Array:
    """Shares kept off 0 and 1, where a normal distribution has no value."""
    return np.clip(share, 1e-12, 1 - 1e-12)


def equal_parts(share: Array, count: int) -> NDArray[np.int64]:
    """Which of `count` equal parts of [0, 1] each share lies in."""
    return np.minimum((share * count).astype(np.int64), count - 1)
