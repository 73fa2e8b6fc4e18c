"""Drawing of a vehicle's limits: speed by thrust, power by speed, and the current that it holds."""

from pathlib import Path
from typing import Any

import numpy as np

from twin.planning.vehicle_limits import VehicleLimits, axes_of, electrical_power_w
from twin.report.plotting import png_figure
from twin.scenario.model import VehicleConfig
from twin.simulate.autopilot import thrust_loads, top_speed_mps


def draw(vehicle: VehicleConfig, limits: VehicleLimits, file: Path) -> None:
    with png_figure(file, 14, 4.5) as figure:
        speed, power = (figure.add_subplot(1, 3, k) for k in (1, 2))
        for name, axis in axes_of(vehicle).items():
            speeds = np.linspace(0, limits.speeds_mps[name], 60)
            velocities = speeds[:, None] * np.array(axis)
            speed.plot(100 * thrust_loads(vehicle, velocities), speeds, label=name)
            power.plot(speeds, electrical_power_w(vehicle, velocities), label=name)
        speed.axhline(limits.speed_mps, ls=":", color="0.4", label="planned speed")
        power.axvline(limits.speed_mps, ls=":", color="0.4")
        speed.set(xlabel="thrust of the busiest thruster [%]", ylabel="speed [m/s]", title=f"Speed of {limits.title}")
        power.set(xlabel="speed [m/s]", ylabel="electrical power [W]", title="Power", ylim=(0, None))
        speed.legend()
        if not vehicle.is_steered_by_fins:
            _draw_currents(figure.add_subplot(1, 3, 3, projection="polar"), vehicle)


def _draw_currents(axes: Any, vehicle: VehicleConfig) -> None:
    bearings = np.linspace(0, 2 * np.pi, 181)
    directions = np.column_stack([np.cos(bearings), np.sin(bearings), np.zeros_like(bearings)])
    axes.plot(bearings, [top_speed_mps(vehicle, direction) for direction in directions])
    axes.set_theta_zero_location("N")
    axes.set_title("Current that it holds, by bearing from the bow [m/s]")
