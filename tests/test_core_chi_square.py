"""Quantiles of the chi-square distribution equal those of scipy.stats; a survey does without its import."""

import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from twin.core.chi_square import chi2_quantile


def test_quantiles_are_those_of_scipy_stats_also_for_fractional_degrees_of_freedom():
    for k in (1, 3, 6, 7.3, 1000.0):
        p = np.array([1e-9, 0.005, 0.5, 0.995, 0.9999])
        np.testing.assert_array_equal(chi2_quantile(p, k), stats.chi2.ppf(p, k))


@pytest.mark.long
def test_a_survey_does_not_import_scipy_stats():
    code = "import sys, twin.survey, twin.recordings.replay; assert 'scipy.stats' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
