"""Physical parameters of the BlueROV2 Heavy.

Source: von Benzon et al. 2022, "An Open-Source Benchmark Simulator: Control of a BlueROV2 Underwater Robot",
J. Mar. Sci. Eng. 10, 1898, Table A1. The body axes of the paper are x forward, y right, z down; here they are x
forward, y left, z up, with the origin at the centre of gravity. The signs of y and z are therefore opposite to the
paper's: z = -0.085 m for the horizontal thrusters, which lie below the centre of gravity.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from twin.core.geometry import Array


def _array(*rows: object) -> Array:
    values = np.array(rows, dtype=np.float64)
    values.setflags(write=False)
    return values


_X, _Y, _Z, _FORE, _SIDE = 0.156, 0.111, -0.085, 0.12, 0.218  # positions of the thrusters [m]
_C = np.sqrt(0.5)  # vectored at 45 deg, the front pair inwards, the rear pair outwards


class VehicleParameters(NamedTuple):
    """Rigid body, hydrodynamics and thrusters of a vehicle; six-vectors are surge, sway, heave, roll, pitch, yaw (SI).

    Args:
        mass_kg, displaced_volume_m3: dry mass, and volume of the displaced water.
        inertia_kgm2: (3,) principal moments of inertia about the body axes, which pass through the centre of gravity.
        centre_of_buoyancy_m: (3,) position of the centre of buoyancy relative to the centre of gravity, in the body.
        added_mass: (6,) diagonal of the added mass matrix M_A [kg, kg m2].
        linear_damping, quadratic_damping: (6,) diagonals of D_l and D_q in the damping matrix D(nu) = D_l + D_q |nu|,
            with nu the body velocity.
        thruster_positions_m, thruster_directions: (8, 3) positions and unit vectors in the body: four horizontal
            thrusters (front right, front left, rear right, rear left), then four vertical ones in the same order.
            Positive thrust pushes the vehicle along the direction.
        thrust_coefficients: coefficients of u^9, u^7, u^5, u^3, u for the thrust [N] of a T200 at command u in [-1, 1].
        thruster_lag: numerator (s, 1) and denominator (s^3, s^2, s, 1) coefficients of the transfer function from
            steady to actual thrust.
        size_m: (3,) length, width, height of the hull.
        hull_centre_m: (3,) centre of the hull in the body.
    """

    mass_kg: float = 13.5
    displaced_volume_m3: float = 0.0134
    inertia_kgm2: Array = _array(0.26, 0.23, 0.37)
    centre_of_buoyancy_m: Array = _array(0.0, 0.0, 0.01)
    added_mass: Array = _array(6.36, 7.12, 18.68, 0.189, 0.135, 0.222)
    linear_damping: Array = _array(13.7, 0.0, 33.0, 0.0, 0.8, 0.0)
    quadratic_damping: Array = _array(141.0, 217.0, 190.0, 1.19, 0.47, 1.5)
    thruster_positions_m: Array = _array(
        [_X, -_Y, _Z], [_X, _Y, _Z], [-_X, -_Y, _Z], [-_X, _Y, _Z],
        [_FORE, -_SIDE, 0.0], [_FORE, _SIDE, 0.0], [-_FORE, -_SIDE, 0.0], [-_FORE, _SIDE, 0.0],
    )  # fmt: skip
    thruster_directions: Array = _array(
        [_C, _C, 0.0], [_C, -_C, 0.0], [_C, -_C, 0.0], [_C, _C, 0.0], *[[0.0, 0.0, 1.0]] * 4
    )
    thrust_coefficients: Array = _array(-140.3, 389.9, -404.1, 176.0, 8.9)
    thruster_lag: tuple[Array, Array] = _array(6136.0, 108700.0), _array(1.0, 89.0, 9258.0, 108700.0)
    size_m: Array = _array(0.457, 0.575, 0.254)
    hull_centre_m: Array = _array(0.0, 0.0, -0.03)

    @property
    def thrust_configuration(self) -> Array:
        """Returns the wrenches [force, moment] (6, 8) about the centre of gravity per newton of thrust [-, m]."""
        torque = np.cross(self.thruster_positions_m, self.thruster_directions)
        return np.vstack([self.thruster_directions.T, torque.T])


BLUEROV2_HEAVY = VehicleParameters()
