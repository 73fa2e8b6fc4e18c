"""Study file (TOML): the scenario, its fixed and varied keys, the sampling, the requirements, and the search."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr

from twin.core.user_files import is_file
from twin.errors import ScenarioError, TwinError
from twin.judge.metrics import empty_metrics
from twin.judge.require import SIGNED, check_metric_names
from twin.scenario.file import find_scene, load_scenario, read_toml, shown, validated
from twin.scenario.model import Section, Source
from twin.studies.distribution import KINDS, Distribution

SamplingMethod = Literal["random", "lhs", "sobol", "saltelli", "grid"]
KeepLevel = Literal["all", "report", "metrics", "none"]
#: Largest number of surveys of a study; limited because all scenarios are validated before the first survey is flown.
MAX_SURVEYS = 100_000
_OBJECTIVES = "tune.objectives"
FIDELITIES = {"rendered", "surrogate"}  #: values of imaging.fidelity in a study with `compare`
DEFAULT_METRICS = (
    "trajectory.final.ate_rmse_m", "map.le90_area_m", "map.completeness_area", "map.le90_m", "map.completeness",
    "vision.points_median", "vision.contrast_median",
)  # fmt: skip


class JointValues(Section):
    """Table of keys that vary jointly: each row has one value for every key."""

    keys: Annotated[tuple[str, ...], Field(min_length=1)] = Field(description="dotted keys of the scenario")
    rows: Annotated[tuple[tuple[Any, ...], ...], Field(min_length=1)] = Field(
        description="one value per key in each row; all rows have equal probability"
    )


class SamplingConfig(Section):
    """Sampling of a study: method, number of samples, and number of seeds per sample."""

    method: SamplingMethod = Field(
        default="random",
        description="independent random samples; Latin hypercube; scrambled Sobol points; Saltelli's design, for Sobol "
        "indices; or a full grid of the listed values",
    )
    samples: int | None = Field(
        default=None,
        ge=1,
        le=10_000_000,
        description="number of samples; each is combined with every cell of the grids; Saltelli's design has "
        "(axes + 2) times as many",
    )
    seeds: int = Field(default=1, ge=1, le=100_000, description="surveys of each sample, each with a different seed")
    paired: bool = Field(
        default=True,
        description="use the same seeds for all samples, so they have the same floor and noise; "
        "else different seeds for each design point",
    )
    seed: int = Field(
        default=1, ge=0, lt=2**31, description="seed of the sampling; the seeds of the surveys count up from it"
    )


class TuningConfig(Section):
    """Settings of the search by `twin tune`; each candidate plan is flown with every sample and seed of the study."""

    search: Annotated[dict[str, Distribution], Field(min_length=1)] = Field(
        description="keys of the scenario to optimise, each with a range (uniform, log_uniform) or values (choice)"
    )
    objectives: Annotated[tuple[str, ...], Field(min_length=1, max_length=4)] = Field(
        description="metrics whose median is optimised, and `risk`, the fraction of surveys that do not pass; the "
        "first duration among them, else the first one, is the cost: the cheapest Pareto-optimal plan is recommended"
    )
    trials: int = Field(default=64, ge=1, le=100_000, description="number of candidates")
    batch: int = Field(
        default=8, ge=1, le=1000, description="candidates proposed at a time, from the results of the earlier batches"
    )
    confirm: int = Field(
        default=4, ge=1, le=1000, description="factor on the number of surveys when a finalist is flown with new seeds"
    )
    verify: int = Field(
        default=3,
        ge=0,
        le=1000,
        description="rendered surveys of a plan in each cell of the grids, all of which must pass before the plan is "
        "recommended, if the search uses the surrogate; 0: the recommended plan is not verified",
    )
    plans: int = Field(
        default=3, ge=1, le=100, description="most plans verified in a round, and cheaper plans at the end"
    )
    rounds: int = Field(
        default=2,
        ge=0,
        le=10,
        description="largest number of further rounds of search while no plan passes in rendered surveys; in these "
        "rounds the surrogate's results are corrected by those of the rendered surveys",
    )
    keep: KeepLevel | None = Field(
        default=None, description="files to keep of rendered surveys; default: `keep` of the study"
    )
    timeout_s: float = Field(
        default=7200.0, gt=0, le=1e7, description="run time after which a rendered survey counts as failed [s]"
    )


class Study(Section):
    """Monte Carlo study: surveys of one scenario, some of whose keys vary."""

    name: str | None = Field(default=None, min_length=1, max_length=80, description="default: the name of the file")
    scenario: str = Field(description="the scenario to vary: a path relative to this file, or a name in scenes/")
    question: str = Field(default="", max_length=200, description="question to answer; a heading of the report")
    seek: str | None = Field(
        default=None, description="a varied numeric key: report first where it reaches require.probability"
    )
    keep: KeepLevel = Field(default="metrics", description="files to keep of each run")
    timeout_s: float = Field(
        default=3600.0, gt=0, le=1e7, description="run time after which a survey counts as failed [s]"
    )
    retries: int = Field(default=2, ge=0, le=100, description="retries if the process of a survey was killed")
    show: tuple[str, ...] = Field(
        default=DEFAULT_METRICS, description="metrics shown in the report, in addition to those with a limit"
    )
    compare: tuple[str, ...] = Field(
        default=(),
        description="metrics, never negative, whose values in rendered and surrogate surveys are compared; needs "
        'vary.imaging.fidelity = { grid = ["rendered", "surrogate"] }',
    )
    set: dict[str, Any] = Field(default={}, description="keys of the scenario that have a fixed value in this study")
    vary: dict[str, Distribution] = Field(default={}, description="distribution of each varied key of the scenario")
    together: tuple[JointValues, ...] = Field(default=(), description="tables of keys that vary jointly")
    sampling: SamplingConfig = SamplingConfig()
    tune: TuningConfig | None = Field(default=None, description="search of `twin tune`")
    require: dict[str, float] = Field(
        default={}, description="limits on metrics of each survey; `probability`: smallest pass probability"
    )

    _source: Source = PrivateAttr(default_factory=lambda: Source(path=Path("study")))

    @property
    def source(self) -> Source:
        """Returns the study file and the line number of each of its keys."""
        return self._source

    @property
    def limits(self) -> dict[str, float]:
        """Returns the limits on the metrics of each survey."""
        return {name: limit for name, limit in self.require.items() if name != "probability"}

    @property
    def probability(self) -> float | None:
        """Returns the required pass probability; None if the study does not set one."""
        return self.require.get("probability")

    @property
    def varied_keys(self) -> list[str]:
        """Returns every key that varies, alone or jointly with others."""
        return [*self.vary, *(key for table in self.together for key in table.keys)]

    @property
    def scenario_file(self) -> Path:
        """Returns the path of the scenario file whose keys the study varies.

        Raises:
            ScenarioError: there is no such file.
        """
        relative = self.source.path.parent / self.scenario
        return find_scene(relative if is_file(relative) else self.scenario)


def load_study(path: str | Path, allow_plugins: bool = False) -> Study:
    """Reads and validates a study file and the scenario file that it names.

    Raises:
        ScenarioError: a file does not exist or is not valid; lists the errors of the study file or, if it has none,
            those of the scenario file, each as `FILE:LINE: key: problem (allowed: ...)`.
    """
    file = find_study(path)
    tree, lines = read_toml(file)
    source = Source(path=file, lines=lines, allow_plugins=allow_plugins)
    for node, section in ((tree, "vary"), (tree, "set"), (tree.get("tune"), "search")):
        if isinstance(node, dict) and isinstance(node.get(section), dict):
            node[section] = dict(flatten_keys(node[section]))
    study = validated(tree, Study, source)
    study._source = source
    if study.name is None:
        study = study.model_copy(update={"name": file.stem})
    errors = [source.describe(error) for error in _errors(study)]
    if errors:
        raise ScenarioError(errors)
    # reports the errors of the scenario itself with its own line numbers
    load_scenario(study.scenario_file, allow_plugins=allow_plugins)
    return study


def find_study(path: str | Path) -> Path:
    """Returns the path of a study file.

    Raises:
        ScenarioError: there is neither such a file nor such a name.
    """
    from twin import scenes

    folder = Path(scenes.__file__).parent / "studies"
    for file in (Path(path), folder / f"{path}.toml"):
        if is_file(file):
            return file
    names = ", ".join(sorted(file.stem for file in folder.glob("*.toml")))
    raise ScenarioError([f"{shown(str(path))}: no such study (allowed: a file, or one of {names})"])


def flatten_keys(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields (dotted key, value) for the entries of nested tables; a table that defines a distribution is one value."""
    for key, value in tree.items():
        if isinstance(value, dict) and value and not value.keys() & set(KINDS):
            yield from flatten_keys(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _errors(study: Study) -> Iterable[TwinError]:
    """Yields the errors that pydantic's validation of single fields does not find."""
    for errors in (_key_errors, _table_errors, _sampling_errors, _metric_errors):
        yield from errors(study)
    try:
        _ = study.scenario_file
    except ScenarioError as error:
        yield TwinError("scenario", error.lines[0])


def _key_errors(study: Study) -> Iterable[TwinError]:
    seen: dict[str, str] = {}
    for study_key, key in named_keys(study):
        if key == "seed":
            yield TwinError(study_key, "the seed cannot be set or varied here", "sampling.seed and sampling.seeds")
        elif key.partition(".")[0] in ("require", "extends"):
            yield TwinError(study_key, "cannot be set or varied", "[require]" if key.startswith("r") else "scenario")
        elif key in seen:
            yield TwinError(study_key, f"is already given by {seen[key]}", "each key once")
        seen.setdefault(key, study_key)


def named_keys(study: Study) -> Iterator[tuple[str, str]]:
    """Yields (dotted name in the study file, key of the scenario) for every key that is set, varied or searched."""
    yield from ((f"set.{key}", key) for key in study.set)
    yield from ((f"vary.{key}", key) for key in study.vary)
    for k, table in enumerate(study.together):
        yield from ((f"together.{k}.keys", key) for key in table.keys)
    if study.tune is not None:
        yield from ((f"tune.search.{key}", key) for key in study.tune.search)


def _table_errors(study: Study) -> Iterable[TwinError]:
    for k, table in enumerate(study.together):
        for row, values in enumerate(table.rows):
            if len(values) != (n_keys := len(table.keys)):
                yield TwinError(f"together.{k}.rows", f"row {row} has {len(values)} values", f"{n_keys}, one per key")


def _sampling_errors(study: Study) -> Iterable[TwinError]:
    sampling = study.sampling
    sampled = [key for key, distribution in study.vary.items() if distribution.is_sampled]
    if sampling.method == "grid":
        if sampling.samples is not None:
            yield TwinError("sampling.samples", "a grid determines the number of samples", "no value")
        for key in sampled:
            if study.vary[key].kind != "choice":
                yield TwinError(f"vary.{key}", f"{study.vary[key].kind} has no list of values", "grid or choice")
    elif not sampled and not study.together:
        if sampling.samples not in (None, 1):
            yield TwinError("sampling.samples", "no key is sampled, so all samples are equal", "sampling.seeds")
    elif sampling.samples is None:
        yield TwinError("sampling.samples", "missing", "a number of samples")
    elif sampling.method in ("sobol", "saltelli") and sampling.samples & (sampling.samples - 1):
        power = 1 << sampling.samples.bit_length()
        yield TwinError("sampling.samples", f"{sampling.samples} is not a power of 2", f"a power of 2, e.g. {power}")
    if (n_surveys := n_planned_surveys(study)) > MAX_SURVEYS:
        remedy = "fewer sampling.samples, sampling.seeds or values of grids"
        yield TwinError("sampling", f"{n_surveys} surveys are too many", f"up to {MAX_SURVEYS}: {remedy}")
    if sampling.method == "saltelli":
        for key in study.vary.keys() - set(sampled):
            yield TwinError(f"vary.{key}", "a grid has no Sobol index", "choice, or another sampling.method")


def n_planned_surveys(study: Study) -> int:
    """Returns the number of surveys of a study, without enumerating them."""
    sampling = study.sampling
    is_grid = sampling.method == "grid"
    cells = math.prod(len(d.values) for d in study.vary.values() if is_grid or not d.is_sampled)
    tables = math.prod(len(table.rows) for table in study.together) if is_grid else 1
    n_axes = sum(d.is_sampled for d in study.vary.values()) + len(study.together)
    points = (sampling.samples or 1) * (n_axes + 2 if sampling.method == "saltelli" and n_axes else 1)
    return (1 if is_grid else points) * cells * tables * sampling.seeds


def _metric_errors(study: Study) -> Iterable[TwinError]:
    tune, fidelity = study.tune, study.vary.get("imaging.fidelity")
    objectives = [name for name in tune.objectives if name != "risk"] if tune else []
    known = empty_metrics()
    for key, names in (("", study.limits), ("show", study.show), ("compare", study.compare), (_OBJECTIVES, objectives)):
        for name in names:
            try:
                check_metric_names([name], known)
            except TwinError as error:
                yield TwinError(key, f"{name}: {error.problem}", error.allowed) if key else error
    for key, distribution in tune.search.items() if tune else ():
        if distribution.kind not in ("uniform", "log_uniform", "choice"):
            allowed = "uniform, log_uniform or choice"
            yield TwinError(f"tune.search.{key}", f"{distribution.kind} cannot be searched", allowed)
    for name in study.compare:
        if name in SIGNED:
            problem = f"{name} can be negative, but the ratio of its medians is compared"
            yield TwinError("compare", problem, "metrics that are never negative, such as map.rmse_m")
    if study.compare and (fidelity is None or fidelity.grid is None or set(fidelity.grid) != FIDELITIES):
        yield TwinError("compare", "needs surveys of both fidelities", "vary.imaging.fidelity with a grid of both")
    if study.seek is not None:
        distribution = study.vary.get(study.seek)
        if distribution is None or not all(isinstance(value, int | float) for value in distribution.values):
            yield TwinError("seek", f"{study.seek!r} is not a varied numeric key", "a key of [vary] with numbers")
        if study.probability is None:
            yield TwinError("seek", "needs a required pass probability", "require.probability")
    if study.probability is not None and not 0 <= study.probability <= 1:
        yield TwinError("require.probability", f"{study.probability:g}: not allowed", "0 to 1")
