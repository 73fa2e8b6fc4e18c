"""Limits of a vehicle and what a survey asks of it: trim, speeds, forces, stopping distance, energy and dives."""

import math
from dataclasses import asdict, dataclass, replace
from typing import Any

import numpy as np
from scipy.optimize import root_scalar

from twin.controllers.segments import Reference
from twin.core import geometry
from twin.core.records import Estimate
from twin.judge.summary_statistics import finite_tree
from twin.report.number_formats import length, percent
from twin.scenario.model import VehicleConfig
from twin.simulate.autopilot import full_force_n, thrust_loads, thruster_lag_s, top_speed_mps
from twin.simulate.compiled_vehicle import CompiledVehicle
from twin.simulate.energy import electrical_power_w, usable_wh
from twin.simulate.hull import physics_timestep_s, trimmed_hull
from twin.simulate.sea import steady_current
from twin.simulate.steady_flight import minimum_speed_mps, turning_radius_m
from twin.simulate.tether import steady_pulls, tether_of
from twin.world.energy import planned_energy, planned_motion
from twin.world.mission import Mission
from twin.world.path_checks import body_velocities
from twin.world.pilot import make_pilot

#: Directions in the body, by name.
AXES = {"forwards": (1.0, 0.0, 0.0), "sideways": (0.0, 1.0, 0.0), "up": (0.0, 0.0, 1.0)}
_BEARINGS = np.linspace(0.0, 2 * np.pi, 72, endpoint=False)
_LEG_S, _SETTLED_S, _STABLE_M = 5.0, 20.0, 0.1  # the last _LEG_S of _SETTLED_S are judged


@dataclass(frozen=True)
class VehicleLimits:
    """Limits of a rigid vehicle in still water without tether, and energy of the planned survey in its mean current."""

    title: str
    voltage_v: float | None  #: stated supply voltage of the thrusters
    controller: str  #: what flies it: "built in", or the plug-in
    buoyancy_n: float  #: net buoyancy, positive upwards
    righting_nm_per_deg: float  #: moment that turns a tilted vehicle back
    speeds_mps: dict[str, float]  #: top speed by direction: the first thruster saturates
    forces_n: dict[str, float]  #: force by direction at which the first thruster saturates
    #: greatest horizontal current, from any side, in which it holds station, with its tether; NaN: it cannot
    current_mps: float
    speed_mps: float  #: planned speed
    load: float  #: thrust of the busiest thruster / full thrust, at the planned speed in the mean current
    stopping_m: float  #: distance from the planned speed to rest at full thrust, with the lag of the thrusters
    coasting_m: float  #: distance from the planned speed to a tenth of it without thrust
    latency_s: float  #: greatest latency of the computer with which leg and station keeping are stable
    hover_h: float  #: endurance at rest, without the reserve of a fifth; NaN: it cannot hover
    cruise_h: float  #: the same at the planned speed
    survey_s: float  #: duration of the survey, with station keeping
    survey_wh: float  #: energy of the survey
    dives: int  #: number of batteries that the survey takes, each with a reserve of a fifth
    minimum_speed_mps: float  #: least speed at which fins keep the height; 0 of a vehicle that hovers
    turning_radius_m: float  #: least radius of a planned turn; 0 of a vehicle that turns on the spot
    full_rudder_radius_m: float  #: radius of a turn with the fins at their greatest angles; 0 as above


def vehicle_limits(mission: Mission) -> VehicleLimits:
    vehicle, plan = mission.scenario.vehicle, mission.plan
    hull, fins, axes = trimmed_hull(vehicle), vehicle.is_steered_by_fins, axes_of(vehicle)
    speed_mps, ahead = plan.speed_mps, np.array(AXES["forwards"])
    (through_water, pulls), energy = planned_motion(mission), planned_energy(mission)
    assert energy.survey_wh is not None and energy.dives is not None  # a rigid vehicle
    rest, cruise = electrical_power_w(vehicle, np.array([np.zeros(3), speed_mps * ahead]))
    return VehicleLimits(
        title=vehicle.title, voltage_v=vehicle.voltage_v, controller=mission.scenario.control.plugin or "built in",
        buoyancy_n=hull.buoyancy_n - hull.weight_n,
        righting_nm_per_deg=math.radians(hull.buoyancy_n * float(hull.centre_of_buoyancy_m[2])),
        speeds_mps={name: top_speed_mps(vehicle, np.array(axis)) for name, axis in axes.items()},
        forces_n={name: full_force_n(vehicle, np.array(axis)) for name, axis in axes.items()},
        current_mps=np.nan if fins else largest_current_mps(mission), speed_mps=speed_mps,
        load=float(thrust_loads(vehicle, through_water, pulls).max()),
        stopping_m=speed_mps * thruster_lag_s(vehicle)
        + stopping_distance_m(vehicle, speed_mps, full_force_n(vehicle, ahead), 0.0),
        coasting_m=stopping_distance_m(vehicle, speed_mps, 0.0, 0.1 * speed_mps), latency_s=largest_latency_s(mission),
        hover_h=np.nan if fins else usable_wh(vehicle) / rest, cruise_h=usable_wh(vehicle) / cruise,
        survey_s=len(through_water) / mission.rig.frame_rate_hz, survey_wh=energy.survey_wh, dives=energy.dives,
        minimum_speed_mps=minimum_speed_mps(vehicle) if fins else 0.0,
        turning_radius_m=turning_radius_m(vehicle, speed_mps) if fins else 0.0,
        full_rudder_radius_m=turning_radius_m(vehicle, speed_mps, share=1.0) if fins else 0.0,
    )  # fmt: skip


def largest_current_mps(mission: Mission) -> float:
    """Returns the greatest current from any side in which the vehicle holds station at the start [m/s]."""
    vehicle, start_m = mission.scenario.vehicle, np.tile(mission.start[:3, 3], (len(_BEARINGS), 1))
    directions = np.column_stack([np.cos(_BEARINGS), np.sin(_BEARINGS), np.zeros_like(_BEARINGS)])
    still, tether = np.zeros_like(directions), tether_of(mission.scenario.tether, mission.start[:3, 3])
    most_mps = min(top_speed_mps(vehicle, direction) for direction in directions)

    def excess(speed_mps: float) -> float:
        current = np.array([speed_mps, 0.0, 0.0])
        pulls = steady_pulls(tether, current, start_m, _BEARINGS, still)
        return float(thrust_loads(vehicle, body_velocities(_BEARINGS, still - current), pulls).max()) - 1

    if not tether.length_m or excess(most_mps) <= 0:
        return most_mps
    return float(root_scalar(excess, bracket=(0.0, most_mps), method="brentq").root)


def axes_of(vehicle: VehicleConfig) -> dict[str, tuple[float, float, float]]:
    """Returns the directions, by name, in which a vehicle can move by its thrusters."""
    return {"forwards": AXES["forwards"]} if vehicle.is_steered_by_fins else AXES


def largest_latency_s(mission: Mission) -> float:
    """Returns the greatest latency up to 1 s [s], in frames, with which the vehicle flies a leg and stops."""
    # from the planned speed, true motion known, to within `_STABLE_M` after `_SETTLED_S`; with fins, it does not stop
    interval_s = 1 / mission.rig.frame_rate_hz
    latencies = interval_s * np.arange(1, round(1 / interval_s) + 1)
    return next((float(late_s - interval_s) for late_s in latencies if not _settles(mission, late_s)), latencies[-1])


def _settles(mission: Mission, latency_s: float) -> bool:
    scenario, interval_s = mission.scenario, 1 / mission.rig.frame_rate_hz
    fins = scenario.vehicle.is_steered_by_fins
    late = scenario.model_copy(update={"control": scenario.control.model_copy(update={"latency": latency_s})})
    leg_s, velocity_mps = (_SETTLED_S, mission.start_velocity_mps) if fins else (_LEG_S, np.zeros(3))
    changed, start = replace(mission, scenario=late), mission.start_of_body
    pilot, still = make_pilot(changed), steady_current(np.zeros(3))
    vehicle = CompiledVehicle(
        scenario.vehicle, still, start, physics_timestep_s(mission.rig.frame_rate_hz, scenario.vehicle),
        start_velocity_mps=velocity_mps,
    )  # fmt: skip
    camera, start_m, yaw = mission.rig.body_from_camera, mission.start[:3, 3], mission.plan.reference(1, 0.0).yaw
    velocity = mission.plan.speed_mps * start[:3, 0]  # along the bow
    to_camera, excursion_m = geometry.adjoint(geometry.inverse(camera)), 0.0
    for time_s in np.arange(0.0, _SETTLED_S, interval_s):
        position, moves = start_m + min(time_s, leg_s) * velocity, time_s < leg_s
        pose, twist = vehicle.world_from_body @ camera, to_camera @ vehicle.twist_body
        wanted = Reference(position, velocity if moves else np.zeros(3), yaw, np.zeros(3))
        vehicle.step(pilot(Estimate(time_s, pose, pose, twist, 0.0, "ok"), wanted), interval_s)
        if time_s > _SETTLED_S - _LEG_S:
            excursion_m = max(excursion_m, float(np.linalg.norm(pose[:3, 3] - position)))
    return excursion_m < _STABLE_M


def stopping_distance_m(vehicle: VehicleConfig, speed_mps: float, force_n: float, end_mps: float) -> float:
    """Returns the distance from a forward speed to `end_mps` under drag and a constant braking force."""
    hull = trimmed_hull(vehicle)
    mass_kg = hull.inertia[3] + hull.added_inertia[3, 3]
    linear, quadratic = hull.linear_drag[3, 3], hull.quadratic_drag[3, 3]
    nodes, weights = np.polynomial.legendre.leggauss(64)
    v = (speed_mps + end_mps + (speed_mps - end_mps) * nodes) / 2
    with np.errstate(divide="ignore"):  # infinite without force and drag
        return float((speed_mps - end_mps) / 2 * weights @ (mass_kg * v / (force_n + linear * v + quadratic * v * v)))


def rows(limits: VehicleLimits) -> list[tuple[str, str]]:
    """Returns the limits as table rows."""

    def of_axes(values: dict[str, float], unit: str, digits: int) -> str:
        return ", ".join(f"{value:.{digits}f} {unit} {name}" for name, value in values.items())

    survey_min = limits.survey_s / 60
    own = [
        ("holds station in", f"{limits.current_mps:.2f} m/s of current from any side"),
        ("endurance", f"{limits.hover_h:.1f} h at rest, {limits.cruise_h:.1f} h at {limits.speed_mps:g} m/s"),
    ]
    if limits.minimum_speed_mps:
        radii = limits.turning_radius_m, limits.full_rudder_radius_m
        own = [
            ("minimum speed", f"{limits.minimum_speed_mps:.2f} m/s through the water; it cannot hover"),
            ("turning radius", f"{radii[0]:.1f} m as planned, {radii[1]:.1f} m at full rudder"),
            ("endurance", f"{limits.cruise_h:.1f} h at {limits.speed_mps:g} m/s"),
        ]
    return [
        *([] if limits.voltage_v is None else [("supply voltage", f"{limits.voltage_v:g} V")]),
        ("controller", limits.controller), ("net buoyancy", f"{limits.buoyancy_n:+.1f} N"),
        ("righting moment", f"{limits.righting_nm_per_deg:.3f} N m per degree"),
        ("top speed", of_axes(limits.speeds_mps, "m/s", 2)), ("full force", of_axes(limits.forces_n, "N", 0)),
        *own[:-1],
        ("busiest thruster", f"{percent(limits.load)} of its thrust at {limits.speed_mps:g} m/s in the mean current"),
        ("stopping distance", f"{length(limits.stopping_m)} at full thrust, {length(limits.coasting_m)} without"),
        ("latency", f"stable up to {limits.latency_s:.2f} s from image to command"), own[-1],
        ("this survey", f"{survey_min:.1f} min, {limits.survey_wh:.1f} W h, {limits.dives} dive(s)"),
    ]  # fmt: skip


def as_json(limits: VehicleLimits, picture: str) -> dict[str, Any]:
    return finite_tree({"schema": "twin.vehicle/1", **asdict(limits), "picture": picture})
