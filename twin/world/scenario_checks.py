"""Contradictions of a scenario that no range of a single key excludes: between keys, or keys without effect."""

from collections.abc import Iterable, Iterator

import numpy as np
from pydantic import BaseModel

from twin.errors import TwinError
from twin.imaging.camera.lens_psf import NEAREST_FOCUS_M
from twin.scenario.model import FAULTS, SENSORS, Scenario, SensorConfig, SnowConfig, TerrainConfig
from twin.simulate.parameters import moves_along_all_axes

_IN_IMAGES = ("cameras", "left_camera", "right_camera", "lamp", "fish")  # parts whose faults change images, as silt
_MESH_KEYS = ("mesh_file", "mesh_up", "mesh_scale")
_FILE_KEYS = ("height_file", "texture_file", "orthophoto_file", "z", "height_spacing_m", "height_range_m")


def contradictions(scenario: Scenario) -> Iterator[TwinError]:
    """Yields an error for each contradiction in a scenario, apart from its floor and objects."""
    if scenario.estimate.plugin is not None and scenario.imaging.fidelity != "rendered":
        yield TwinError("estimate.plugin", "needs images; the surrogate has none", 'imaging.fidelity = "rendered"')
    yield from _of_prior(scenario)
    yield from _of_tasks(scenario)
    yield from _of_sea(scenario)
    yield from _of_faults(scenario)
    if scenario.control.latency != "stated":
        problem, allowed = "has no effect without a stated latency", 'control.latency = "stated"'
        yield from keys_without_effect("control", scenario.control, ["computer_speed"], problem, allowed)
    if scenario.plan.cross_rise_m and not scenario.plan.cross_lines:
        yield TwinError("plan.cross_rise_m", "has no effect without cross lines", "0, or plan.cross_lines above 0")
    if scenario.plan.cross_rise_m and scenario.vehicle.dynamics == "kinematic":
        problem, allowed = "a kinematic vehicle moves in a horizontal plane", '0, or vehicle.dynamics = "rigid"'
        yield TwinError("plan.cross_rise_m", problem, allowed)
    if scenario.vehicle.is_steered_by_fins:
        yield from _of_fins(scenario)
    elif scenario.vehicle.dynamics == "rigid" and not moves_along_all_axes(scenario.vehicle):
        problem = f"{len(scenario.vehicle.thrusters)} thrusters cannot push along all axes and turn about the vertical"
        yield TwinError("vehicle.thrusters", problem, 'thrusters that can, or vehicle.dynamics = "kinematic"')
    if "beacons" in scenario.navigation.aiding and not scenario.beacons:
        yield TwinError("navigation.aiding", "'beacons': the scenario defines no beacon", "with a [[beacons]] section")
    if "imu" in scenario.navigation.aiding and scenario.imu is None:
        yield TwinError("navigation.aiding", "'imu': the scenario has no IMU", "with an [imu] section")
    if "imu" in scenario.navigation.aiding and scenario.imaging.fidelity != "rendered":
        yield TwinError("navigation.aiding", "'imu': the surrogate has no IMU", 'imaging.fidelity = "rendered"')
    for key in ("dvl_range_m", "altimeter_range_m"):
        nearest_m, farthest_m = getattr(scenario.navigation, key) or (0.0, 1.0)
        if nearest_m >= farthest_m:
            yield TwinError(f"navigation.{key}", f"[{nearest_m:g}, {farthest_m:g}]: no range", "the nearest one first")
    if scenario.sensor is not None:
        yield from _of_sensor(scenario.sensor, scenario.rig.frame_rate_hz)
    yield from _of_lens(scenario)
    yield from _of_snow(scenario.snow)


def floor_contradictions(t: TerrainConfig) -> Iterator[TwinError]:
    """Yields an error for each key of the section `terrain` that is missing, or has no effect on its kind of floor."""
    if t.texture_file is None:
        yield from keys_without_effect(
            "terrain", t, ["texture_tiling"], "has no effect without a photo", "with terrain.texture_file"
        )
    elif t.cover is not None:
        yield TwinError("terrain.cover", "has no effect on a floor with terrain.texture_file", "one of the two")
    if t.kind == "mesh":
        if t.mesh_file is None:
            yield TwinError("terrain.mesh_file", "missing", 'a mesh, as terrain.kind is "mesh"')
        unused = (*_FILE_KEYS, "cover", "plugin", "wall_texture")
        problem = 'has no effect on a mesh (terrain.kind = "mesh")'
        yield from keys_without_effect("terrain", t, unused, problem, "without it")
        return
    problem = f"has no effect on terrain.kind = {t.kind!r}"
    yield from keys_without_effect("terrain", t, _MESH_KEYS, problem, 'terrain.kind = "mesh"')
    if t.kind != "file":
        problem = f"has no effect on a generated floor (terrain.kind = {t.kind!r})"
        yield from keys_without_effect("terrain", t, _FILE_KEYS, problem, 'terrain.kind = "file"')
        return
    if t.height_file is None:
        yield TwinError("terrain.height_file", "missing", 'a DEM, as terrain.kind is "file"')
    problem = 'has no effect on a measured DEM (terrain.kind = "file")'
    yield from keys_without_effect("terrain", t, ["plugin"], problem, "another kind")


def keys_without_effect(
    path: str, section: BaseModel, keys: Iterable[str], problem: str, allowed: str
) -> Iterator[TwinError]:
    """Yields an error for each of the keys of a section (at the dotted path) that is not set to its default."""
    for key in keys:
        if getattr(section, key) != type(section).model_fields[key].default:
            yield TwinError(f"{path}.{key}", problem, allowed)


def _of_sensor(sensor: SensorConfig, frame_rate_hz: float) -> Iterator[TwinError]:
    if sensor.exposure_min_ms > sensor.exposure_max_ms:
        problem = f"{sensor.exposure_min_ms:g}: longer than the longest exposure"
        allowed = f"up to sensor.exposure_max_ms = {sensor.exposure_max_ms:g}"
        yield TwinError("sensor.exposure_min_ms", problem, allowed)
    for key in ("exposure_max_ms", "readout_ms"):
        if (time_ms := getattr(sensor, key)) > 1000 / frame_rate_hz:
            longest_ms = np.floor(1e5 / frame_rate_hz) / 100
            allowed = f"up to {longest_ms:g} at rig.frame_rate_hz = {frame_rate_hz:g}"
            yield TwinError(f"sensor.{key}", f"{time_ms:g}: longer than a frame", allowed)
    problem = f'is unused: sensor.white_balance is "{sensor.white_balance}"'
    for key, mode in (("white_gains", "gains"), ("white_temperature_k", "temperature")):
        if sensor.white_balance != mode:
            yield from keys_without_effect("sensor", sensor, [key], problem, f'with sensor.white_balance = "{mode}"')


def _of_lens(scenario: Scenario) -> Iterator[TwinError]:
    lens = scenario.lens
    for key, used in (("diffraction", lens.diffraction), ("focus_m", lens.focus_m > 0)):
        if used and scenario.sensor is None:
            yield TwinError(f"lens.{key}", "needs the f-number and the pixel size of the sensor", "with [sensor]")
    if 0 < lens.focus_m < NEAREST_FOCUS_M:
        yield TwinError("lens.focus_m", f"{lens.focus_m:g}: too near", f"0, or {NEAREST_FOCUS_M:g} or more")


def _of_fins(scenario: Scenario) -> Iterator[TwinError]:
    """Yields an error for each key that asks a vehicle that is steered by fins to stop, sidestep or climb."""
    problem = "a vehicle that is steered by fins flies level, bow first, at a minimum speed"
    if scenario.plan.pattern != "lawnmower":
        yield TwinError("plan.pattern", f"{scenario.plan.pattern!r}: {problem}", '"lawnmower"')
    plan = ("cross_lines", "fill_gaps", "height")
    yield from keys_without_effect("plan", scenario.plan, plan, f"cannot be flown: {problem}", "the default")
    control = ("hold_s", "natural_frequency_radps", "height")
    yield from keys_without_effect("control", scenario.control, control, f"has no effect: {problem}", "the default")
    for k, _ in enumerate(scenario.tasks):
        yield TwinError(f"tasks.{k}", f"cannot be flown: {problem}", "no [[tasks]]")


def _of_tasks(scenario: Scenario) -> Iterator[TwinError]:
    names = [task.name for task in scenario.tasks]
    for k, task in enumerate(scenario.tasks):
        if task.name in names[:k]:
            yield TwinError(f"tasks.{k}.name", f"{task.name!r} is the name of another task", "a name of its own")
        if task.after_track is not None and task.start_s is not None:
            yield TwinError(f"tasks.{k}.start_s", "contradicts after_track", "one of the two")
        if task.within_leg and task.after_track is not None:
            yield TwinError(f"tasks.{k}.within_leg", "contradicts after_track", "one of the two")
        if task.within_leg and scenario.plan.pattern == "loops":
            yield TwinError(f"tasks.{k}.within_leg", "has no effect on arcs", 'false, or plan.pattern = "lawnmower"')
        if scenario.vehicle.dynamics == "kinematic":
            problem, allowed = "a kinematic vehicle moves in a horizontal plane", 'vehicle.dynamics = "rigid"'
            yield TwinError(f"tasks.{k}.altitude_m", problem, allowed)


def _of_prior(scenario: Scenario) -> Iterator[TwinError]:
    t, blind = scenario.terrain, scenario.terrain.prior == "none"
    if blind:
        unused = ("prior_file", "prior_smoothing_m", "prior_offset_m")
        yield from keys_without_effect("terrain", t, unused, "has no effect without a prior", 'terrain.prior = "floor"')
        if scenario.plan.along_contours:
            yield TwinError("plan.along_contours", 'needs a known floor (terrain.prior = "none")', "false")
        if scenario.plan.height == "plane" and scenario.control.height == "planned":
            yield TwinError("plan.height", '"plane" lies at a height above an unknown floor', '"floor"')
    if t.prior_file is not None and t.kind != "file":
        yield TwinError("terrain.prior_file", f"has no effect on terrain.kind = {t.kind!r}", 'terrain.kind = "file"')


def _of_sea(scenario: Scenario) -> Iterator[TwinError]:
    current, waves = scenario.current, scenario.waves
    if scenario.vehicle.dynamics == "kinematic":
        problem, allowed = "has no effect on a kinematic vehicle", 'zero, or vehicle.dynamics = "rigid"'
        sea = ("velocity_mps", "gust_mps", "tide_mps", "file", *["gust_vertical_mps"] * bool(current.gust_vertical_mps))
        yield from keys_without_effect("current", current, sea, problem, allowed)
        yield from keys_without_effect("waves", waves, ("height_m", "wind_mps"), problem, allowed)
        yield from keys_without_effect("tether", scenario.tether, ("length_m",), problem, allowed)
    if waves.wind_mps is not None:
        problem = "is unused: it follows from waves.wind_mps and fetch_m"
        yield from keys_without_effect("waves", waves, ("period_s",), problem, "one of the two")
    if current.file is not None:
        problem = "is unused: current.file has the mean current"
        yield from keys_without_effect("current", current, ("velocity_mps", "profile"), problem, "one of the two")
    if not current.is_netcdf:
        problem = "is unused: current.file is not NetCDF"
        yield from keys_without_effect("current", current, ("file_start", "file_place_deg"), problem, "a file *.nc")
    if current.profile == "log" and current.roughness_m >= current.reference_height_m:
        problem = f"{current.roughness_m:g}: the current vanishes at current.reference_height_m"
        yield TwinError("current.roughness_m", problem, f"below {current.reference_height_m:g}")


def _of_faults(scenario: Scenario) -> Iterator[TwinError]:
    kinematic = scenario.vehicle.dynamics == "kinematic"
    numbered = {"thruster": len(scenario.vehicle.thrusters), "lamp": len(scenario.lamps)}
    for k, fault in enumerate(scenario.faults):
        key = f"faults.{k}"
        if fault.type not in FAULTS[fault.part]:
            problem = f"{fault.type}: not simulated for {fault.part}"
            yield TwinError(f"{key}.type", problem, ", ".join(FAULTS[fault.part]))
        n = numbered.get(fault.part)
        if fault.part == "thruster" and kinematic:
            yield TwinError(f"{key}.part", "a kinematic vehicle has no thrusters", 'vehicle.dynamics = "rigid"')
        elif n == 0:
            yield TwinError(f"{key}.part", f"the scenario has no {fault.part}", "a part that it has")
        elif n is None and fault.number is not None:
            yield TwinError(f"{key}.number", f"has no effect on {fault.part}", "no value")
        elif n is not None and (fault.part == "thruster" if fault.number is None else fault.number > n):
            yield TwinError(f"{key}.number", "missing" if fault.number is None else f"{fault.number}", f"1 to {n}")
        if fault.type == "gust" and kinematic:
            yield TwinError(f"{key}.type", "has no effect on a kinematic vehicle", 'vehicle.dynamics = "rigid"')
        if fault.type != "gust":
            problem = f"has no effect on {fault.type}"
            yield from keys_without_effect(key, fault, ["direction_deg"], problem, 'type = "gust"')
        if fault.part == "tether" and (not scenario.tether.length_m or kinematic or fault.size <= 0):
            problem = "needs a tether, a rigid vehicle and a slack above 0"
            yield TwinError(f"{key}.part", problem, "tether.length_m and size above 0")
        if fault.part in SENSORS and fault.part not in scenario.navigation.aiding:
            yield TwinError(f"{key}.part", f"{fault.part} is not used", "a sensor in navigation.aiding")
        when = [name for name in ("start_s", "at_m", "per_hour") if getattr(fault, name) is not None]
        if len(when) != 1:
            problem = f"given together with {when[1]}" if when else "missing"
            yield TwinError(f"{key}.{(when or ['start_s'])[0]}", problem, "either start_s, at_m or per_hour")
        if fault.at_m is None:
            yield from keys_without_effect(key, fault, ["radius_m"], "has no effect without a place", "with at_m")
        what = {"delayed": "a delay", "silt": "a share of the contrast", "school": "a number of fish"}.get(fault.type)
        if what is not None and fault.size <= 0:
            yield TwinError(f"{key}.size", f"{fault.size:g}: not {what}", "above 0")
        if fault.type == "intermittent" and not 0 <= fault.size <= 1:
            yield TwinError(f"{key}.size", f"{fault.size:g}: not a share of the frames", "0 to 1")
        if scenario.imaging.fidelity == "surrogate" and (fault.part in _IN_IMAGES or fault.type == "silt"):
            allowed = 'imaging.fidelity = "rendered"'
            yield TwinError(f"{key}.part", f"{fault.part}: the surrogate has no images", allowed)


def _of_snow(snow: SnowConfig) -> Iterator[TwinError]:
    if snow.junge_exponent is None:
        limits, problem = ("diameter_min_m", "diameter_max_m"), "is unused: all particles have diameter_m"
        yield from keys_without_effect("snow", snow, limits, problem, "with snow.junge_exponent")
    elif snow.diameter_min_m >= snow.diameter_max_m:
        problem = f"{snow.diameter_min_m:g}: not smaller than the largest diameter"
        yield TwinError("snow.diameter_min_m", problem, f"below snow.diameter_max_m = {snow.diameter_max_m:g}")
