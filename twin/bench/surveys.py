"""Whole surveys: their cost relative to plain rendering of their frames, and their accuracy; surrogate, alignment."""

from collections.abc import Callable, Sequence
from functools import partial
from importlib.util import find_spec
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from twin import survey
from twin.bench.measurement import N_ROUNDS, BenchmarkRow, alternate, processor_ms
from twin.bench.plain_renderer import PlainRenderer
from twin.core.timing import Stopwatch
from twin.estimate.alignment import align
from twin.estimate.pipeline import Navigator
from twin.exchange import posegraph
from twin.report import recording, survey_page
from twin.report.run_folder import load_run
from twin.scenario.file import load_scenario
from twin.session.assembly import make_navigator, open_world
from twin.studies.flight import fly
from twin.studies.study_file import load_study
from twin.studies.surveys import refusals, surveys
from twin.world.mission import prepare


def survey_rows(label: str, scene: str, overrides: Sequence[str], n_rounds: int) -> list[BenchmarkRow]:
    """Returns the rows of a small survey of a scene: its processor time, report, recording, folder and accuracy."""
    flown = np.array([_survey(scene, overrides) for _ in range(n_rounds)]).T
    timed, floor = ("processor time", "report", "recording"), "mujoco.Renderer, same views"
    units = {"run folder": "MB", "final position error (RMSE)": "mm", "map error (LE90)": "mm", "NEES of position": "1"}
    return [
        *(BenchmarkRow(f"{label}: {name}", "ms", flown[k], floor, flown[3]) for k, name in enumerate(timed)),
        *(BenchmarkRow(f"{label}: {name}", units[name], flown[k, :1]) for k, name in enumerate(units, 4)),
    ]


def _survey(scene: str, overrides: Sequence[str]) -> list[float]:
    """Returns the processor times of survey, report, recording and plain rendering [ms]; size [MB]; accuracy."""
    scenario = load_scenario(scene, overrides)
    mission, results = prepare(scenario), []
    with TemporaryDirectory(prefix="twin-") as temporary, PlainRenderer(mission.terrain, mission.rig) as plain:
        folder = Path(temporary) / "run"
        survey_ms = processor_ms(lambda: results.append(survey.run(scenario, folder, outputs=())))
        run, metrics = results[0].contents, results[0].metrics
        size_mb = folder_mb(folder)
        poses = run.trajectories["truth"].world_from_camera
        views = [*poses, *(poses[run.keyframes.frames] @ mission.rig.left_from_right)]
        works: Sequence[Callable[[], object]] = (
            lambda: survey_page.write_report(folder),
            lambda: recording.record_run(load_run(folder)),
            lambda: [plain.render(view) for view in views],
        )
        times = survey_ms, *map(processor_ms, works)
    errors_m = metrics["trajectory"]["final"]["ate_rmse_m"], metrics["map"]["le90_m"]
    return [*times, size_mb, *(1e3 * error_m for error_m in errors_m), metrics["consistency"]["nees_position_mean"]]


def folder_mb(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6


def study_row(name: str) -> BenchmarkRow:
    """Returns the processor time of surveys of a study in a process that has flown others of it before."""
    study = load_study(name)
    with TemporaryDirectory(prefix="twin-") as folder:
        first, *others = islice(surveys(study, Path(folder), refusals(study), shuffled=True), 13)
        fly(first)
        times = [processor_ms(partial(fly, one)) for one in others]
    return BenchmarkRow(f"survey of study {name}", "ms", times)


def surrogate_rows() -> list[BenchmarkRow]:
    """Returns the rows of a survey by the surrogate and of the final alignment of its network."""
    mission, numbers = prepare(load_scenario("reef", ["imaging.fidelity=surrogate"])), iter(range(N_ROUNDS + 1))
    with TemporaryDirectory(prefix="twin-") as temporary, open_world(mission, Stopwatch()) as world:
        vehicle: Any = world.vehicle
        at_rest, duration_s = np.zeros(len(vehicle.thrusters.factors)), mission.n_frames / mission.rig.frame_rate_hz
        whole, physics = alternate(
            lambda: survey.run(mission.scenario, Path(temporary) / str(next(numbers)), outputs=None),
            lambda: vehicle.step(at_rest, duration_s),
        )
    row = BenchmarkRow("surrogate survey", "ms", whole, "its compiled vehicle alone", physics)
    if find_spec("gtsam") is None:
        return [row, BenchmarkRow("GA", "ms", [], "gtsam: not installed")]
    import gtsam

    with (
        TemporaryDirectory(prefix="twin-") as folder, open_world(mission, Stopwatch()) as world,
        make_navigator(mission, world, Path(folder), Stopwatch()) as navigator,
    ):  # fmt: skip
        assert isinstance(navigator, Navigator)
        survey.fly(mission, world, navigator, lambda *_: None)
        posegraph.write(Path(folder) / "network.g2o", navigator.finish())
        graph, start = gtsam.readG2o(f"{folder}/network.g2o", True)
        network, cov = navigator.network, np.eye(6) * 1e-12
    graph.add(gtsam.PriorFactorPose3(0, start.atPose3(0), gtsam.noiseModel.Gaussian.Covariance(cov)))

    def by_gtsam() -> None:
        marginals = gtsam.Marginals(graph, gtsam.LevenbergMarquardtOptimizer(graph, start).optimize())
        for node in network.nodes:
            marginals.marginalCovariance(node.number)

    ours = partial(align, network.nodes, network.links, {0: cov}, mission.rig, network.noise)
    alignment, floor = alternate(ours, by_gtsam)
    return [row, BenchmarkRow("GA", "ms", alignment, "gtsam: Levenberg-Marquardt and marginals", floor)]
