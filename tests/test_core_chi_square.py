"""The NEES interval is by quantiles of the chi-square distribution; a survey does without the import of scipy.stats."""

import subprocess
import sys

import numpy as np
import pytest
from scipy import stats

from twin.estimate.vision.wide_search import _CHI2
from twin.judge.consistency import CONSISTENT_SHARE, nees_interval


def test_quantiles_are_those_of_scipy_stats_also_for_fractional_degrees_of_freedom():
    for k in (1, 3, 7.3, 1000.0):
        expected = stats.chi2.interval(CONSISTENT_SHARE, 3 * k)
        np.testing.assert_allclose(nees_interval(k), np.array(expected) / k, rtol=1e-12)
    assert pytest.approx(stats.chi2.ppf(0.9999, 6), rel=1e-12) == _CHI2


@pytest.mark.long
def test_a_survey_does_not_import_scipy_stats():
    code = "import sys, twin.survey, twin.recordings.replay; assert 'scipy.stats' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True)
