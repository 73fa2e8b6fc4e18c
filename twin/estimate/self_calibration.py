"""Self-calibration: parameters that all factors of the alignment share and that are estimated together with the poses.

They are the scale error of the DVL and, if the calibration states a standard deviation for them, the yaw between the
cameras and the error of the baseline since the calibration. A yaw adds (1 + x^2) times itself to the disparity at
column x, which images that overlap contradict, over relief more than over a level floor; the baseline is observable
by navigation sensors only. What is not observable remains as uncertain as the calibration states, in the covariances of
all poses.

So do errors of image positions that a wrong lens or port leaves (`image_errors`), if row differences show that there
are any.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array
from twin.core.links import Links
from twin.core.quality import CalibrationEstimate, DisparityOffset
from twin.core.records import SensorNoise, StereoRig
from twin.estimate.adjustment.pose_graph import Effect, SharedPrior, Solution
from twin.estimate.vision.image_errors import coefficient_sigmas

DVL, YAW, BASELINE = "dvl", "yaw", "baseline"


class MeasuredErrors(NamedTuple):
    """Errors of the calibration that links and row differences show."""

    #: offset of all disparities by the links; used if the calibration states that it may have one.
    offset: DisparityOffset | None = None
    row_pattern: float = 0.0  #: RMS of a systematic row difference between the cameras [focal lengths]; 0: none


NOTHING_MEASURED = MeasuredErrors()


class SharedParameters(NamedTuple):
    """Shared parameters: named ones, and after them the coefficients of `image_errors` if there are any errors."""

    names: Sequence[str]  #: in the order of the columns
    prior: SharedPrior
    image_errors: bool = False

    def effect_on(self, links: Links) -> Effect | None:
        """Returns the effect of the parameters on measured motions; None if there is none."""
        # a longer baseline makes all lengths longer: those of the adjusted motions, as with the measured ones, a
        # shorter baseline would reduce the residuals
        if YAW not in self.names and BASELINE not in self.names and not self.image_errors:
            return None

        def effect(i_from_j: Array, batch: slice) -> tuple[Array, Array]:
            derivatives, at = (np.zeros((len(i_from_j), *shape, len(self.prior.mean))) for shape in ((6,), ()))
            if self.image_errors:
                derivatives[:, :, len(self.names) :] = links.by_image_errors[batch]
            if YAW in self.names:
                k = self.names.index(YAW)
                derivatives[:, :, k], at[:, k] = links.by_yaw[batch], links.yaw_rad[batch]
            if BASELINE in self.names:
                rotation, moved = i_from_j[:, :3, :3], i_from_j[:, :3, 3]
                derivatives[:, 3:, self.names.index(BASELINE)] = np.einsum("nji,nj->ni", rotation, moved)
            return derivatives, at

        return effect

    def estimate(self, solution: Solution) -> CalibrationEstimate:
        """Returns the errors of the calibration at the solution; those that are not estimated are 0."""
        value, cov = np.zeros(2), np.zeros((2, 2))
        found = [(row, self.names.index(name)) for row, name in enumerate((YAW, BASELINE)) if name in self.names]
        rows, columns = [row for row, _ in found], [column for _, column in found]
        value[rows] = solution.state.shared[columns]
        cov[np.ix_(rows, rows)] = solution.shared_cov[np.ix_(columns, columns)]
        return CalibrationEstimate(float(value[0]), float(value[1]), cov)


def shared_parameters(rig: StereoRig, noise: SensorNoise, with_dvl: bool, measured: MeasuredErrors) -> SharedParameters:
    """Returns the parameters to estimate."""
    rows = [(DVL, 0.0, noise.dvl_scale)] if with_dvl else []
    if rig.yaw_sigma_rad > 0:
        rows.append((YAW, *fused(rig.yaw_sigma_rad, measured.offset)))
    if rig.baseline_sigma > 0:
        rows.append((BASELINE, 0.0, rig.baseline_sigma))
    names, mean, sigma = zip(*rows, strict=True) if rows else ((), (), ())
    errors = coefficient_sigmas(measured.row_pattern) if measured.row_pattern else np.zeros(0)
    prior = SharedPrior(np.append(np.array(mean, np.float64), 0 * errors), np.append(sigma, errors))
    return SharedParameters(names, prior, bool(len(errors)))


def fused(sigma: float, offset: DisparityOffset | None) -> tuple[float, float]:
    """Returns the mean and the standard deviation of an error whose prior is (0, sigma) and which was measured."""
    if offset is None:
        return 0.0, sigma
    information = sigma**-2 + offset.sigma**-2
    return offset.estimate * offset.sigma**-2 / information, information**-0.5
