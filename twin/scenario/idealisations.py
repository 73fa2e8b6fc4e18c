"""Idealisations of a scenario: effects of a real survey that it leaves out, so that simulated errors are too small."""

from __future__ import annotations

from twin.scenario.model import CalibrationErrorConfig, Scenario


def idealisations(scenario: Scenario) -> list[str]:
    """Returns a sentence for each of cameras, water, light, vehicle and restored colours that is idealised.

    A surrogate survey has one more sentence, which states that no images were rendered.
    """
    subjects = {
        "The cameras are ideal": _cameras(scenario),
        "The water is ideal": _water(scenario),
        "The light is ideal": _light(scenario),
        "The vehicle is ideal": _vehicle(scenario),
        "The restored colours are ideal": _restoration(scenario),
    }
    sentences = [f"{subject}: {', '.join(missing)}." for subject, missing in subjects.items() if missing]
    if scenario.imaging.fidelity == "surrogate":
        sentences.append("No images were rendered: visual measurements are sampled from a fitted error model.")
    return sentences


def _cameras(scenario: Scenario) -> list[str]:
    """Returns the names of the effects of real cameras that the scenario leaves out."""
    sensor = scenario.sensor
    absent = {
        "no calibration error": scenario.calibration_error == CalibrationErrorConfig(),
        "no port": scenario.port.kind == "none",
        "no motion blur": sensor is None or not sensor.motion_blur,
    }
    return _named(absent)


def _water(scenario: Scenario) -> list[str]:
    """Returns the names of the effects of real water that the scenario leaves out."""
    water = scenario.water
    clear = water.jerlov == "clear" and water.absorption_per_m is None and water.spectrum_file is None
    given_zero = [value is not None and not any(value) for value in (water.absorption_per_m, water.scattering_per_m)]
    absent = {
        "no absorption": clear or given_zero[0],
        "no scattering": clear or given_zero[1] or water.turbidity == 0 or scenario.imaging.scattering == "none",
        "no multiple scattering": not clear and scenario.imaging.scattering == "single",
        "no marine snow": scenario.snow.density_per_m3 == 0,
        "no current": not any(scenario.current.velocity_mps),
    }
    return _named(absent)


def _light(scenario: Scenario) -> list[str]:
    """Returns the names of the effects of real lighting that the scenario leaves out."""
    absent = {
        "no shadows of the lamps": bool(scenario.lamps) and not scenario.imaging.shadows,
        "no caustics": scenario.sun.illuminance_lx > 0 and scenario.sun.caustics == 0,
    }
    return _named(absent)


def _vehicle(scenario: Scenario) -> list[str]:
    """Returns the names of the effects of a real vehicle that the scenario leaves out."""
    return _named({"no forces, no inertia": scenario.vehicle.dynamics == "kinematic"})


def _restoration(scenario: Scenario) -> list[str]:
    """Returns the names of the errors of a restoration of real images that the scenario leaves out.

    Simulated images are restored with the true values of water, lamps, vignetting and exposure.
    """
    made = scenario.imaging.fidelity != "surrogate" and scenario.map.orthomosaic
    return _named({"no error of water, lamps, vignetting and exposure": made and scenario.map.restore})


def _named(absent: dict[str, bool]) -> list[str]:
    """Returns the names of the effects that are absent."""
    return [name for name, is_absent in absent.items() if is_absent]
