"""Idealisations of a scenario: effects of a real survey that it leaves out, so that simulated errors are too small."""

from twin.scenario.model import CalibrationErrorConfig, Scenario


def idealisations(scenario: Scenario) -> list[str]:
    """Returns a sentence for each of cameras, water, light, vehicle and restored colours that is idealised.

    A surrogate survey has one more sentence, which states that no images were rendered.
    """
    sensor, surrogate = scenario.sensor, scenario.imaging.fidelity == "surrogate"
    absent = {
        "The cameras are ideal": {
            "no calibration error": scenario.calibration_error == CalibrationErrorConfig(),
            "no port": scenario.port.kind == "none",
            "no motion blur": sensor is None or not sensor.motion_blur,
        },
        "The water is ideal": _absent_in_water(scenario),
        "The light is ideal": {
            "no shadows of the lamps": bool(scenario.lamps) and not scenario.imaging.shadows,
            "no caustics": scenario.sun.illuminance_lx > 0 and scenario.sun.caustics == 0,
        },
        "The vehicle is ideal": {"no forces, no inertia": scenario.vehicle.dynamics == "kinematic"},
        "The restored colours are ideal": {  # they are restored with the true values
            "no error of water, lamps, vignetting and exposure": scenario.map.orthomosaic
            and scenario.map.restore
            and not surrogate
        },
    }
    missing = {subject: [name for name in effects if effects[name]] for subject, effects in absent.items()}
    sentences = [f"{subject}: {', '.join(names)}." for subject, names in missing.items() if names]
    if surrogate:
        sentences.append("No images were rendered: visual measurements are sampled from a fitted error model.")
    return sentences


def _absent_in_water(scenario: Scenario) -> dict[str, bool]:
    water = scenario.water
    clear = water.jerlov == "clear" and water.absorption_per_m is None and water.spectrum_file is None
    given_zero = [value is not None and not any(value) for value in (water.absorption_per_m, water.scattering_per_m)]
    return {
        "no absorption": clear or given_zero[0],
        "no scattering": clear or given_zero[1] or water.turbidity == 0 or scenario.imaging.scattering == "none",
        "no multiple scattering": not clear and scenario.imaging.scattering == "single",
        "no marine snow": scenario.snow.density_per_m3 == 0,
        "no current": scenario.current.is_still,
        "no gusts": not scenario.current.is_still
        and not (scenario.current.gust_mps or scenario.current.gust_vertical_mps),
        "no waves": scenario.waves.is_calm,
    }
