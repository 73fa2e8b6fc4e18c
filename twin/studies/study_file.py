"""Study file (TOML): the scenario, its fixed and varied keys, the sampling, the requirements, and the search."""

import math
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr

from twin.core.user_files import is_file
from twin.errors import ScenarioError, TwinError
from twin.judge.metrics import empty_metrics
from twin.judge.verdict import SIGNED, check_metric_names
from twin.scenario.file import find_scene, load_scenario, read_toml, shown, validated
from twin.scenario.model import Section, Source
from twin.studies.distribution import KINDS, Distribution

SamplingMethod = Literal["random", "lhs", "sobol", "saltelli", "grid"]
KeepLevel = Literal["all", "report", "metrics", "none"]
#: Largest number of surveys of a study; limited because all scenarios are validated before the first survey is flown.
MAX_SURVEYS = 100_000
MAX_VERIFY = 1000  #: largest number of rendered surveys of a plan
_MOST_PROBABLE = 0.996  # pass probability that they show if all of them pass: 0.996^1000 < 0.025
FIDELITY = "imaging.fidelity"
FIDELITIES = {"rendered", "surrogate"}  #: its values in a study with `compare`
DEFAULT_METRICS = (
    "trajectory.final.ate_rmse_m", "map.le90_area_m", "map.completeness_area", "map.le90_m", "map.completeness",
    "vision.points_median", "vision.contrast_median",
)  # fmt: skip


class JointValues(Section):
    """Table of keys that vary jointly: each row has one value for every key."""

    keys: Annotated[tuple[str, ...], Field(min_length=1)]
    """dotted keys of the scenario"""
    rows: Annotated[tuple[tuple[Any, ...], ...], Field(min_length=1)]
    """one value per key in each row; all rows have equal probability"""


class SamplingConfig(Section):
    """Sampling of a study: method, number of samples, and number of seeds per sample."""

    method: SamplingMethod = "random"
    """independent random samples; Latin hypercube; scrambled Sobol points; Saltelli's design, for Sobol indices; or a
    full grid of the listed values"""
    samples: int | None = Field(default=None, ge=1, le=10_000_000)
    """number of samples; each is combined with every cell of the grids; Saltelli's design has (axes + 2) times as
    many"""
    seeds: int = Field(default=1, ge=1, le=100_000)
    """surveys of each sample, each with a different seed"""
    paired: bool = True
    """use the same seeds for all samples, so they have the same floor and noise; else different seeds for each design
    point"""
    seed: int = Field(default=1, ge=0, lt=2**31)
    """seed of the sampling; the seeds of the surveys count up from it"""


class TuningConfig(Section):
    """Settings of the search by `twin tune`; each candidate plan is flown with every sample and seed of the study."""

    search: Annotated[dict[str, Distribution], Field(min_length=1)]
    """keys of the scenario to optimise, each with a range (uniform, log_uniform) or values (choice)"""
    objectives: Annotated[tuple[str, ...], Field(min_length=1, max_length=4)]
    """metrics whose median is optimised, and `risk`, the fraction of surveys that do not pass; the first duration among
    them, else the first one, is the cost: the cheapest Pareto-optimal plan is recommended"""
    trials: int = Field(default=64, ge=1, le=100_000)
    """number of candidates"""
    batch: int = Field(default=8, ge=1, le=1000)
    """candidates proposed at a time, from the results of the earlier batches"""
    confirm: int = Field(default=4, ge=1, le=1000)
    """factor on the number of surveys when a finalist is flown with new seeds"""
    verify: int | None = Field(default=None, ge=0, le=MAX_VERIFY)
    """most rendered surveys of a plan: a plan is recommended only if the lower bound of its pass probability in them
    reaches require.probability; default: as many as show it although two fail; 0: none, and no plan is recommended"""
    plans: int = Field(default=3, ge=1, le=100)
    """most plans verified in a round, and cheaper plans at the end"""
    rounds: int = Field(default=2, ge=0, le=10)
    """largest number of further rounds of search while no plan passes in rendered surveys; in these rounds the
    surrogate's results are corrected by those of the rendered surveys"""
    keep: KeepLevel | None = None
    """files to keep of rendered surveys; default: `keep` of the study"""
    timeout_s: float = Field(default=7200.0, gt=0, le=2e6)
    """run time after which a rendered survey counts as failed [s]"""


class Study(Section):
    """Monte Carlo study: surveys of one scenario, some of whose keys vary."""

    name: str | None = Field(default=None, min_length=1, max_length=80)
    """default: the name of the file"""
    scenario: str
    """the scenario to vary: a path relative to this file, or a name in scenes/"""
    question: str = Field(default="", max_length=200)
    """question to answer; a heading of the report"""
    seek: str | None = None
    """a varied numeric key: report first where it reaches require.probability"""
    keep: KeepLevel = "metrics"
    """files to keep of each run"""
    timeout_s: float = Field(default=3600.0, gt=0, le=2e6)
    """run time after which a survey counts as failed [s]"""
    retries: int = Field(default=2, ge=0, le=100)
    """retries if the process of a survey was killed"""
    show: tuple[str, ...] = DEFAULT_METRICS
    """metrics shown in the report, in addition to those with a limit"""
    compare: tuple[str, ...] = ()
    """metrics, never negative, whose values in rendered and surrogate surveys are compared; needs
    vary.imaging.fidelity = { grid = ["rendered", "surrogate"] }"""
    sea_trial: bool | None = None
    """also in the conditions of scenes/conditions/sea_trial.toml (calibration errors, current, gusts, marine snow)
    that neither the study nor its scenario sets; default: in the rendered surveys of `twin tune` only"""
    set: dict[str, Any] = {}
    """keys of the scenario that have a fixed value in this study"""
    vary: dict[str, Distribution] = {}
    """distribution of each varied key of the scenario"""
    together: tuple[JointValues, ...] = ()
    """tables of keys that vary jointly"""
    sampling: SamplingConfig = SamplingConfig()
    tune: TuningConfig | None = None
    """search of `twin tune`"""
    require: dict[str, float] = {}
    """limits on metrics of each survey; `probability`: smallest pass probability"""

    _source: Source = PrivateAttr(default_factory=lambda: Source(path=Path("study")))

    @property
    def source(self) -> Source:
        return self._source

    @property
    def limits(self) -> dict[str, float]:
        return {name: limit for name, limit in self.require.items() if name != "probability"}

    @property
    def probability(self) -> float | None:
        return self.require.get("probability")

    @property
    def varied_keys(self) -> list[str]:
        return [*self.vary, *(key for table in self.together for key in table.keys)]

    def axes(self, listed: bool) -> dict[str | tuple[str, ...], Distribution]:
        """Returns the varied keys, or jointly varied ones, whose values are listed as a grid, or else are sampled."""
        is_grid, joint = self.sampling.method == "grid", {t.keys: Distribution(choice=t.rows) for t in self.together}
        laws: dict[Any, Distribution] = {**self.vary, **joint}
        return {keys: law for keys, law in laws.items() if (is_grid or not law.is_sampled) == listed}

    @property
    def n_surveys(self) -> int:
        plan, n_axes = self.sampling, len(self.axes(listed=False))
        points = (plan.samples or 1) * (n_axes + 2 if plan.method == "saltelli" and n_axes else 1)
        return points * math.prod(len(law.values) for law in self.axes(listed=True).values()) * plan.seeds

    @property
    def scenario_file(self) -> Path:
        """Returns the path of the scenario file; raises ScenarioError if there is none."""
        relative = self.source.path.parent / self.scenario
        return find_scene(relative if is_file(relative) else self.scenario)


def load_study(path: str | Path, allow_plugins: bool = False) -> Study:
    """Reads and validates a study file and the scenario file that it names.

    Raises ScenarioError if a file does not exist or is not valid; it lists the errors of the study file or, if it has
    none, those of the scenario file, each as `FILE:LINE: key: problem (allowed: ...)`.
    """
    file = _find_study(path)
    tree, lines = read_toml(file)
    source = Source(path=file, lines=lines, allow_plugins=allow_plugins)
    for node, section in ((tree, "vary"), (tree, "set"), (tree.get("tune"), "search")):
        if isinstance(node, dict) and isinstance(node.get(section), dict):
            node[section] = dict(flat_keys(node[section]))
    study = validated(tree, Study, source)
    study._source = source
    if study.name is None:
        study = study.model_copy(update={"name": file.stem})
    rules = (*_key_rules(study), *_sampling_rules(study), *_metric_rules(study), *_goal_rules(study))
    errors = [source.describe(TwinError(*error)) for is_broken, *error in rules if is_broken]
    if errors:
        raise ScenarioError(errors)
    # reports the errors of the scenario itself with its own line numbers
    load_scenario(study.scenario_file, allow_plugins=allow_plugins)
    return study


def _find_study(path: str | Path) -> Path:
    from twin import scenes

    folder = Path(scenes.__file__).parent / "studies"
    for file in (Path(path), folder / f"{path}.toml"):
        if is_file(file):
            return file
    names = ", ".join(sorted(file.stem for file in folder.glob("*.toml")))
    raise ScenarioError([f"{shown(str(path))}: no such study (allowed: a file, or one of {names})"])


def flat_keys(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Yields (dotted key, value) for the entries of nested tables; a table that defines a distribution is one value."""
    for key, value in tree.items():
        if isinstance(value, dict) and value and not value.keys() & set(KINDS):
            yield from flat_keys(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def named_keys(study: Study) -> Iterator[tuple[str, str]]:
    """Yields (dotted name in the study file, key of the scenario) for every key that is set, varied or searched."""
    yield from ((f"{table}.{key}", key) for table in ("set", "vary") for key in getattr(study, table))
    yield from ((f"together.{k}.keys", key) for k, table in enumerate(study.together) for key in table.keys)
    yield from ((f"tune.search.{key}", key) for key in (study.tune.search if study.tune else ()))


#: A rule that the validation of single fields does not check: whether it is broken; field, problem, allowed values.
Rule = tuple[bool, str, str, str]


def _key_rules(study: Study) -> Iterator[Rule]:
    first: dict[str, str] = {}
    for name, key in named_keys(study):
        other, is_seed, section = first.setdefault(key, name), key == "seed", key.partition(".")[0]
        yield is_seed, name, "the seed cannot be set or varied here", "sampling.seed and sampling.seeds"
        yield section == "require", name, "cannot be set or varied", "[require]"
        yield section == "extends", name, "cannot be set or varied", "scenario"
        yield other != name and not is_seed, name, f"is already given by {other}", "each key once"
    for k, table in enumerate(study.together):
        n = len(table.keys)
        for row, values in enumerate(table.rows):
            problem = f"row {row} has {len(values)} values"
            yield len(values) != n, f"together.{k}.rows", problem, f"{n}, one per key"


def _sampling_rules(study: Study) -> Iterator[Rule]:
    method, n, field = study.sampling.method, study.sampling.samples, "sampling.samples"
    is_grid, is_sampled = method == "grid", bool(study.axes(listed=False))
    yield is_grid and n is not None, field, "a grid determines the number of samples", "no value"
    for key, law in study.vary.items():
        problem = f"{law.kind} has no list of values"
        yield is_grid and law.kind not in ("grid", "choice"), f"vary.{key}", problem, "grid or choice"
    useless = not is_grid and not is_sampled and not study.sea_trial and n not in (None, 1)
    yield useless, field, "no key is sampled, so all samples are equal", "sampling.seeds"
    yield is_sampled and n is None, field, "missing", "a number of samples"
    m = n or 1
    no_power = is_sampled and method in ("sobol", "saltelli") and m & (m - 1) != 0
    yield no_power, field, f"{m} is not a power of 2", f"a power of 2, e.g. {1 << m.bit_length()}"
    allowed = f"up to {MAX_SURVEYS}: fewer sampling.samples, sampling.seeds or values of grids"
    yield study.n_surveys > MAX_SURVEYS, "sampling", f"{study.n_surveys} surveys are too many", allowed
    for key in study.axes(listed=True) if method == "saltelli" else ():
        yield True, f"vary.{key}", "a grid has no Sobol index", "choice, or another sampling.method"


def _metric_rules(study: Study) -> Iterator[Rule]:
    known, tune = empty_metrics(), study.tune
    objectives = [name for name in tune.objectives if name != "risk"] if tune else []
    named = {"": study.limits, "show": study.show, "compare": study.compare, "tune.objectives": objectives}
    for field, name in ((field, name) for field, names in named.items() for name in names):
        try:
            check_metric_names([name], known)
        except TwinError as error:
            yield True, field or error.field, f"{name}: {error.problem}" if field else error.problem, error.allowed
    for key, law in tune.search.items() if tune else ():
        cannot, allowed = law.kind not in ("uniform", "log_uniform", "choice"), "uniform, log_uniform or choice"
        yield cannot, f"tune.search.{key}", f"{law.kind} cannot be searched", allowed


def _goal_rules(study: Study) -> Iterator[Rule]:
    """Yields the rules for the comparison of both fidelities, the required probability, and the scenario."""
    fidelity = study.vary.get(FIDELITY)
    for name in study.compare:
        problem = f"{name} can be negative, but the ratio of its medians is compared"
        yield name in SIGNED, "compare", problem, "metrics that are never negative, such as map.rmse_m"
    for name in study.tune.objectives if study.tune else ():
        problem = f"{name} can be negative, and its least value is not the best one"
        yield name in SIGNED, "tune.objectives", problem, "metrics that are never negative, such as map.rmse_m"
    has_both = fidelity is not None and {*map(repr, fidelity.grid or ())} == {*map(repr, FIDELITIES)}
    single, allowed = bool(study.compare) and not has_both, "vary.imaging.fidelity with a grid of both"
    yield single, "compare", "needs surveys of both fidelities", allowed
    varies = study.tune is not None and FIDELITY in {*study.varied_keys, *study.tune.search}
    yield varies, "tune", f"{FIDELITY} varies, but plans are verified with rendered images", "one fidelity"
    if study.seek is not None:
        law = study.vary.get(study.seek)
        is_numeric = law is not None and all(isinstance(value, int | float) for value in law.values)
        yield not is_numeric, "seek", f"{study.seek!r} is not a varied numeric key", "a key of [vary] with numbers"
        yield study.probability is None, "seek", "needs a required pass probability", "require.probability"
    if study.probability is not None:
        outside = not 0 <= study.probability <= 1
        yield outside, "require.probability", f"{study.probability:g}: not allowed", "0 to 1"
        never = study.tune is not None and _MOST_PROBABLE < study.probability <= 1
        problem = f"{study.probability:g} cannot be shown by {MAX_VERIFY} rendered surveys of a plan"
        yield never, "require.probability", problem, f"with [tune], up to {_MOST_PROBABLE}"
    try:
        _ = study.scenario_file
    except ScenarioError as error:
        yield True, "scenario", error.lines[0], ""
