"""Pass probability as a monotone function of a key: isotonic regression, and what its likelihood ratio shows.

The surveys are sorted so that the pass probability p falls from one value of the key to the next. Its maximum
likelihood estimate is the isotonic regression of pass (1) and fail (0). With p(x) fixed to p0 at one value x, the
estimate is that of the values before x, at least p0, and that of the values after x, at most p0. Twice the difference
of both log-likelihoods follows a law without unknown parameters (Banerjee & Wellner 2001, Ann. Stat. 29, 1699; for
pass and fail data: 2005, Scand. J. Stat. 32, 405), so that p(x) differs from p0 where it exceeds `CRITICAL`.
"""

import math
from bisect import bisect_left
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from scipy.optimize import isotonic_regression
from scipy.special import xlogy

from twin.studies.statistics import Array

CRITICAL = 2.27  #: 95th percentile of the law of Banerjee and Wellner


class FallingCurve(NamedTuple):
    """Numbers of surveys and of passes at k distinct values of a key, in the order in which the probability falls."""

    values: Array  #: (k,) ascending, or descending if the pass probability rises with the key
    n: Array  #: (k,)
    passes: Array  #: (k,)
    fraction: Array  #: (k,) isotonic estimate of the pass probability
    design_effect: float  #: variance of the number of passes / its variance if all surveys were independent
    rises: bool  #: whether the pass probability rises with the key

    def deviance_at(self, k: int, required: float) -> float:
        """Returns twice the log-likelihood lost if the pass probability at value number k is the required one."""
        before, after = _isotonic(self.passes[:k], self.n[:k]), _isotonic(self.passes[k:], self.n[k:])
        fixed = np.concatenate([np.maximum(before, required), np.minimum(after, required)])
        fixed[k] = required
        return 2 * (self._log_likelihood(self.fraction) - self._log_likelihood(fixed))

    @property
    def deviance(self) -> float:
        """Returns twice the log-likelihood of the estimate above that of a constant pass probability."""
        constant = np.full(len(self.n), self.passes.sum() / self.n.sum())
        return 2 * (self._log_likelihood(self.fraction) - self._log_likelihood(constant))

    def _log_likelihood(self, fraction: Array) -> float:
        return float(np.sum(xlogy(self.passes, fraction) + xlogy(self.n - self.passes, 1 - fraction)))

    def shown(self, required: float) -> tuple[int, int]:
        """Returns the number of values, from the first, shown to reach a probability, and the first shown to miss it.

        Both tests at a value use all surveys on the side where the probability is closer to the required one, so that
        a value next to one that is shown, on the far side of the limit, is shown as well.
        """
        indices, critical = range(len(self.values)), CRITICAL * self.design_effect

        def differs(k: int, is_beyond: bool) -> bool:
            return bool(is_beyond) and self.deviance_at(k, required) > critical

        n_reached = bisect_left(indices, True, key=lambda k: not differs(k, self.fraction[k] > required))
        return n_reached, bisect_left(indices, True, key=lambda k: differs(k, self.fraction[k] < required))

    def crossing(self, required: float) -> float:
        """Returns the value at which the estimate falls below a probability; infinite if it does not, by its sign."""
        n, end = int(np.sum(self.fraction >= required)), math.copysign(math.inf, self.values[-1] - self.values[0])
        if n in (0, len(self.values)):
            return end if n else -end
        return float(self.values[n - 1] + self.values[n]) / 2


def falling_curve(x: ArrayLike, passed: ArrayLike, clusters: ArrayLike, rises: bool) -> FallingCurve:
    """Returns the curve of surveys (n,) with values x of a key and cluster labels; `rises`: p rises with x."""
    values, index = np.unique(np.asarray(x, float), return_inverse=True)
    success = np.asarray(passed, float)
    order = slice(None, None, -1 if rises else 1)
    n = np.bincount(index)[order].astype(float)
    passes = np.bincount(index, success)[order].astype(float)
    fraction = _isotonic(passes, n)
    effect = _design_effect(success, fraction[order][index], clusters)
    return FallingCurve(values[order], n, passes, fraction, effect, rises)


def _isotonic(passes: Array, n: Array) -> Array:
    """Returns the falling estimate (k,) of the fraction of passes; none for k = 0."""
    if len(n) == 0:
        return n
    result: Any = isotonic_regression(passes / n, weights=n, increasing=False)
    return np.clip(result.x, 0.0, 1.0)


def _design_effect(success: Array, expected: Array, clusters: ArrayLike) -> float:
    """Returns the design effect (Kish 1965) from the residuals of clusters: 1 to the mean number of surveys in one."""
    labels, index = np.unique(np.asarray(clusters), return_inverse=True)
    most = len(success) / len(labels)
    variance = float(np.sum(expected * (1 - expected)))
    if most == 1 or variance == 0:
        return most
    return float(np.clip(np.sum(np.bincount(index, success - expected) ** 2) / variance, 1.0, most))
