"""Assembly of a survey: world, visual measurements and estimators, as the scenario specifies them."""

from collections.abc import Generator, Iterator
from contextlib import contextmanager, nullcontext
from functools import cache
from pathlib import Path

from twin.core.checkpoint import Checkpoints
from twin.core.timing import StageTimer
from twin.estimate.pipeline import Navigator
from twin.estimate.stereo_vision import StereoVision
from twin.estimate.vision_interface import Vision
from twin.kernels import source_hash
from twin.plugin.loading import CONTROLLERS, ESTIMATORS, TERRAINS, source_files
from twin.plugin.navigator import Estimators, navigator_of
from twin.plugin.protocols import EstimatorSetup
from twin.report.run_writer import environment
from twin.scenario.file import input_files
from twin.scenario.model import Scenario
from twin.world.mission import Mission
from twin.world.world import World

_OF_THE_MACHINE = ("machine", "system", "cpus")  # of env.json: other machines may continue a run if the rest is equal


def checkpoints_of(scenario: Scenario, out: Path, interval_s: float | None) -> Checkpoints:
    """Returns the checkpoints of a survey, which belong to its scenario, its input files and this program."""
    identity = {"scenario": scenario.fingerprint(), "record": scenario.record} | program()
    return Checkpoints(out, identity, _files_of(scenario), interval_s)


def _files_of(scenario: Scenario) -> Iterator[Path]:
    """Yields the input files of a scenario and the files of its plug-ins; these are loaded only when it is read."""
    yield from input_files(scenario)
    for section, group in (("terrain", TERRAINS), ("control", CONTROLLERS), ("estimate", ESTIMATORS)):
        yield from source_files(f"{section}.plugin", group, getattr(scenario, section).plugin)


@cache
def program() -> dict[str, str]:
    """Returns what results depend on to the last bit: a hash of the sources, with the processor, and the packages."""
    versions = {name: text for name, text in environment().items() if name not in _OF_THE_MACHINE}
    return versions | {"sources": source_hash(Path(__file__).parent.parent / "api.py")}


def open_world(mission: Mission, stopwatch: StageTimer) -> World:
    """Returns the world of a mission; raises TwinError if the error model is missing or cannot be used."""
    # imported here: MuJoCo takes 20 MB that a surrogate survey does not need
    if mission.scenario.imaging.fidelity == "rendered":
        from twin.world.rendered_world import RenderedWorld

        return RenderedWorld(mission, stopwatch)
    from twin.surrogate import error_model_file
    from twin.surrogate.surrogate_world import SurrogateWorld

    return SurrogateWorld(mission, stopwatch, error_model_file.load(mission.scenario.imaging.error_model))


@contextmanager
def make_navigator(mission: Mission, world: World, folder: Path, stopwatch: StageTimer) -> Generator[Estimators]:
    """Opens the estimators or the plug-in (TwinError if it is not found); images and tiles go to `folder`/keyframes."""
    if mission.scenario.imaging.fidelity == "surrogate":
        from twin.surrogate.surrogate_world import SurrogateWorld

        assert isinstance(world, SurrogateWorld)
        with navigator_with(mission, world.vision, stopwatch) as navigator:
            yield navigator
        return
    plugin, settings = mission.scenario.estimate.plugin, mission.scenario.estimator_settings()
    setup = EstimatorSetup(mission.rig, mission.start, mission.scenario.believed_noise())
    with image_vision(mission, folder, stopwatch) as vision, navigator_of(plugin, setup, settings, vision) as navigator:
        yield navigator


@contextmanager
def closing(navigator: Estimators) -> Generator[Estimators]:
    """Closes the estimators of a checkpoint, and the files of their images, at the end."""
    vision = navigator.network.vision
    with vision if isinstance(vision, StereoVision) else nullcontext(), navigator:
        yield navigator


def image_vision(mission: Mission, folder: Path, stopwatch: StageTimer) -> StereoVision:
    """Returns the source of visual measurements from images; it uses the believed calibration, not the true one."""
    cell_m = mission.scenario.plan.altitude_m / mission.rig.focal_px
    settings, noise = mission.scenario.estimator_settings(), mission.scenario.believed_noise()
    return StereoVision(mission.rig, settings, folder / "keyframes", cell_m, stopwatch, noise)


def navigator_with(mission: Mission, vision: Vision, stopwatch: StageTimer) -> Navigator:
    """Returns the estimators; they receive the believed calibration and noise and the planned start, but no truth."""
    settings, noise = mission.scenario.estimator_settings(), mission.scenario.believed_noise()
    return Navigator(mission.rig, settings, mission.start, noise, vision, stopwatch=stopwatch)
