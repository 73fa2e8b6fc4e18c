import numpy as np

from twin.core import geometry
from twin.core.geometry import Array
from twin.core.records import ImuReadings
from twin.core.settings import braking_factor

_ACCELERATION = np.full(6, 2.0)  # sigma of an underwater vehicle [rotation, translation] (rad/s2, m/s2)
_FIRST_VELOCITY = np.ones(6)  # standard deviation of the velocity before it is measured [rad/s, m/s]
_GATE = 30.0  # largest chi2 (6 degrees of freedom) of a measured pose; above it, the measurement is rejected


class MotionFilter:
    """Extended Kalman filter of the camera's pose in a reference camera and of its velocity, from frame to frame.

    Nearly constant velocity (Bar-Shalom, Li & Kirubarajan 2001, section 6.2.2): where the image determines a pose
    poorly, it follows from the velocity. A measurement that contradicts the prediction is rejected. `pose` (4, 4) is
    that of the last frame in the reference camera, its errors are motions [rotation, translation] (rad, m) in the axes
    of the camera: pose = true pose @ exp(error). `velocity` (6,) is the twist of the camera in its own axes [rad/s,
    m/s].
    """

    def __init__(self, stops_if_blind: bool = True):
        self._stops = stops_if_blind
        self.pose, self.velocity = np.eye(4), np.zeros(6)
        self._blind_s = 0.0  # time since the last measurement
        self._cov = np.zeros((12, 12))
        self._cov[6:, 6:] = np.diag(_FIRST_VELOCITY**2)

    @property
    def cov(self) -> Array:
        return self._cov[:6, :6]

    def set_velocity(self, velocity: Array) -> None:
        """Sets the velocity (6,), as uncertain as before the first measurement."""
        self.velocity, self._blind_s = velocity, 0.0
        self._cov[6:], self._cov[:, 6:] = 0.0, 0.0
        self._cov[6:, 6:] = np.diag(_FIRST_VELOCITY**2)

    def restart(self) -> None:
        """Makes the last frame the reference: its pose becomes the identity, exactly; the velocity remains."""
        self.pose = np.eye(4)
        self._cov[:6], self._cov[:, :6] = 0.0, 0.0

    def predict(self, interval_s: float, _: ImuReadings | None = None) -> None:
        """Predicts the pose of the next frame; after a time without measurements, the velocity decays."""
        self.velocity = braking_factor(self._blind_s, interval_s, self._stops) * self.velocity
        self._blind_s += interval_s
        motion = geometry.exp(self.velocity * interval_s)
        self.pose = geometry.nearest_rigid(self.pose @ motion)
        transition = np.eye(12)
        transition[:6, :6] = geometry.adjoint(geometry.inverse(motion))
        transition[:6, 6:] = np.eye(6) * interval_s
        self._cov = transition @ self._cov @ transition.T + _acceleration_cov(interval_s)

    def correct(self, measured: Array, cov: Array) -> bool:
        """Fuses a measured pose (4, 4) with its covariance (6, 6); returns whether it agrees with the prediction."""
        innovation = geometry.log(geometry.inverse(self.pose) @ measured)
        gain = np.linalg.solve(self._cov[:6, :6] + cov, self._cov[:6]).T
        if not innovation @ np.linalg.solve(self._cov[:6, :6] + cov, innovation) <= _GATE:  # nor if it is NaN
            return False
        self._blind_s = 0.0
        update = gain @ innovation
        self.pose = geometry.nearest_rigid(self.pose @ geometry.exp(update[:6]))
        self.velocity = self.velocity + update[6:]
        updated = self._cov - gain @ self._cov[:6]
        self._cov = (updated + updated.T) / 2
        return True


def _acceleration_cov(interval_s: float) -> Array:
    """Returns the covariance (12, 12) of pose and velocity that white-noise acceleration adds within an interval."""
    # a constant one (Bar-Shalom et al. 2001, section 6.3.2) would reverse the velocity error at each frame
    velocity = np.diag((_ACCELERATION * interval_s) ** 2)
    return np.asarray(np.kron([[interval_s**2 / 3, interval_s / 2], [interval_s / 2, 1.0]], velocity), np.float64)
