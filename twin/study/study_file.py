"""The study as a TOML file: a scenario, what is fixed in it, what varies and how, and what is required."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field, PrivateAttr

from twin.errors import ScenarioError, TwinError
from twin.judge.metrics import unflown
from twin.judge.require import check_names
from twin.scenario.file import find_scene, load_scenario, read_toml, validated
from twin.scenario.model import Section, Source
from twin.study.spread import KINDS, Spread

METHODS = Literal["random", "lhs", "sobol", "saltelli", "grid"]
KEEP = Literal["all", "report", "metrics", "none"]
SHOWN = (
    "trajectory.final.ate_rmse_m", "map.le90_m", "map.completeness", "vision.points_median", "vision.contrast_median",
)  # fmt: skip


class Together(Section):
    """Keys that vary together: each row is one value for every key."""

    keys: Annotated[tuple[str, ...], Field(min_length=1)] = Field(description="dotted keys of the scenario")
    rows: Annotated[tuple[tuple[Any, ...], ...], Field(min_length=1)] = Field(
        description="values that belong together, each row as often as any other"
    )


class Sampling(Section):
    """Which samples are drawn, and with how many seeds each is flown."""

    method: METHODS = Field(
        default="random",
        description="independent draws; Latin hypercube; scrambled Sobol points; Saltelli's design, for Sobol "
        "indices; or every combination of listed values",
    )
    samples: int | None = Field(
        default=None,
        ge=1,
        le=10_000_000,
        description="to draw; each meets every cell of the grids; Saltelli's design flies (keys + 2) times as many",
    )
    seeds: int = Field(default=1, ge=1, le=100_000, description="surveys of each sample, each with another seed")
    paired: bool = Field(
        default=True,
        description="all samples share the same seeds, so that floor and noise do not differ between settings; "
        "else each draw of the samples has seeds of its own",
    )
    seed: int = Field(default=1, ge=0, lt=2**31, description="of the draws; the surveys' seeds count up from it")


class Tuning(Section):
    """What `twin tune` searches: each candidate flies all surveys of the study."""

    search: Annotated[dict[str, Spread], Field(min_length=1)] = Field(
        description="keys of the scenario to choose well: each uniform, log_uniform or choice"
    )
    objectives: Annotated[tuple[str, ...], Field(min_length=1, max_length=4)] = Field(
        description="metrics to make good, by their median, and `risk`: the share that does not pass; the first decides"
    )
    trials: int = Field(default=64, ge=1, le=100_000, description="candidates flown")
    batch: int = Field(default=8, ge=1, le=1000, description="candidates chosen at a time, from all flown before them")
    confirm: int = Field(default=4, ge=1, le=1000, description="times as many surveys of a finalist, with fresh seeds")


class Study(Section):
    """Many surveys that differ in what varies."""

    name: str | None = Field(default=None, min_length=1, max_length=80, description="the file's name where not given")
    scenario: str = Field(description="the scenario that varies: relative to this file, or a name in scenes/")
    question: str = Field(default="", max_length=200, description="what the study is to answer; heads the report")
    seek: str | None = Field(
        default=None, description="a varied number: how far it may go until fewer than require.probability pass"
    )
    keep: KEEP = Field(default="metrics", description="what stays of each run's folder")
    timeout_s: float = Field(default=3600.0, gt=0, le=1e7, description="a survey that takes longer has failed [s]")
    retries: int = Field(default=2, ge=0, le=100, description="more attempts where a survey's process was killed")
    show: tuple[str, ...] = Field(default=SHOWN, description="metrics of the report, beside those required")
    set: dict[str, Any] = Field(default={}, description="keys of the scenario that are fixed here")
    vary: dict[str, Spread] = Field(default={}, description="keys of the scenario, and how each is spread")
    together: tuple[Together, ...] = Field(default=(), description="tables of values that belong together")
    sampling: Sampling = Sampling()
    tune: Tuning | None = Field(default=None, description="what twin tune searches")
    require: dict[str, float] = Field(
        default={}, description="limits on metrics of each survey; `probability`: least share of surveys that pass"
    )

    _source: Source = PrivateAttr(default_factory=lambda: Source(path=Path("study")))

    @property
    def source(self) -> Source:
        """Where the study was read."""
        return self._source

    @property
    def limits(self) -> dict[str, float]:
        """What every survey must keep."""
        return {name: limit for name, limit in self.require.items() if name != "probability"}

    @property
    def probability(self) -> float | None:
        """The least share of surveys that must pass."""
        return self.require.get("probability")

    @property
    def varied(self) -> list[str]:
        """Every key that varies."""
        return [*self.vary, *(key for table in self.together for key in table.keys)]

    @property
    def base(self) -> Path:
        """The file of the scenario that varies."""
        beside = self.source.path.parent / self.scenario
        return find_scene(beside if beside.is_file() else self.scenario)


def load_study(path: str | Path) -> Study:
    """Reads a study file, or a name in scenes/studies/.

    Raises:
        ScenarioError: every fault of the file, each as `FILE:LINE: key: what is wrong`.
    """
    file = find_study(path)
    tree, lines = read_toml(file)
    source = Source(path=file, lines=lines)
    for node, section in ((tree, "vary"), (tree, "set"), (tree.get("tune"), "search")):
        if isinstance(node, dict) and isinstance(node.get(section), dict):
            node[section] = dict(flattened(node[section]))
    study = validated(tree, Study, source)
    study._source = source
    if study.name is None:
        study = study.model_copy(update={"name": file.stem})
    faults = [source.fault(fault) for fault in _faults(study)]
    if faults:
        raise ScenarioError(faults)
    load_scenario(study.base)  # its own faults, with its own lines
    return study


def find_study(path: str | Path) -> Path:
    """The file of a study: a path that exists, or the name of one in scenes/studies/."""
    import scenes

    folder = Path(scenes.__file__).parent / "studies"
    for file in (Path(path), folder / f"{path}.toml"):
        if file.is_file():
            return file
    names = ", ".join(sorted(file.stem for file in folder.glob("*.toml")))
    raise ScenarioError([f"{path}: no such study (allowed: a file, or one of {names})"])


def flattened(tree: dict[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted keys and their values; a table with the name of a distribution in it is a value."""
    for key, value in tree.items():
        if isinstance(value, dict) and value and not value.keys() & set(KINDS):
            yield from flattened(value, f"{prefix}{key}.")
        else:
            yield prefix + key, value


def _faults(study: Study) -> Iterable[TwinError]:
    """What is wrong with a study whose every value is right by itself."""
    yield from _key_faults(study)
    yield from _table_faults(study)
    yield from _sampling_faults(study)
    yield from _metric_faults(study)
    try:
        _ = study.base
    except ScenarioError as error:
        yield TwinError("scenario", error.lines[0])


def _key_faults(study: Study) -> Iterable[TwinError]:
    seen: dict[str, str] = {}
    for where, key in named_keys(study):
        if key == "seed":
            yield TwinError(where, "the seed is not varied", "sampling.seeds")
        elif key.partition(".")[0] in ("require", "extends"):
            yield TwinError(where, "is no key of a survey", "[require]" if key.startswith("r") else "scenario")
        elif key in seen:
            yield TwinError(where, f"is given by {seen[key]} already", "one place for a key")
        seen.setdefault(key, where)


def named_keys(study: Study) -> Iterator[tuple[str, str]]:
    """Where a key of the scenario is named, and the key."""
    yield from ((f"set.{key}", key) for key in study.set)
    yield from ((f"vary.{key}", key) for key in study.vary)
    for k, table in enumerate(study.together):
        yield from ((f"together.{k}.keys", key) for key in table.keys)
    if study.tune is not None:
        yield from ((f"tune.search.{key}", key) for key in study.tune.search)


def _table_faults(study: Study) -> Iterable[TwinError]:
    for k, table in enumerate(study.together):
        for row, values in enumerate(table.rows):
            if len(values) != (wanted := len(table.keys)):
                yield TwinError(f"together.{k}.rows", f"row {row} is {len(values)} long", f"{wanted}, a value a key")


def _sampling_faults(study: Study) -> Iterable[TwinError]:
    sampling = study.sampling
    drawn = [key for key, spread in study.vary.items() if spread.is_drawn]
    if sampling.method == "grid":
        if sampling.samples is not None:
            yield TwinError("sampling.samples", "a grid has as many samples as combinations", "left out")
        for key in drawn:
            if study.vary[key].kind != "choice":
                yield TwinError(f"vary.{key}", f"{study.vary[key].kind} has no list of values", "grid or choice")
    elif not drawn and not study.together:
        if sampling.samples not in (None, 1):
            yield TwinError("sampling.samples", "nothing is drawn, so samples are all alike", "sampling.seeds")
    elif sampling.samples is None:
        yield TwinError("sampling.samples", "missing", "a number of samples")
    elif sampling.method in ("sobol", "saltelli") and sampling.samples & (sampling.samples - 1):
        power = 1 << sampling.samples.bit_length()
        yield TwinError("sampling.samples", f"{sampling.samples}: Sobol points come in powers of 2", f"as {power}")
    if sampling.method == "saltelli":
        for key in study.vary.keys() - set(drawn):
            yield TwinError(f"vary.{key}", "a grid has no Sobol index", "choice, or another sampling.method")


def _metric_faults(study: Study) -> Iterable[TwinError]:
    known = unflown()
    for name in study.limits:
        try:
            check_names([name], known)
        except TwinError as error:
            yield error
    shown = [("show", name) for name in study.show]
    if study.tune is not None:
        shown += [("tune.objectives", name) for name in study.tune.objectives if name != "risk"]
        for key, spread in study.tune.search.items():
            if spread.kind not in ("uniform", "log_uniform", "choice"):
                yield TwinError(f"tune.search.{key}", f"{spread.kind} has no ends", "uniform, log_uniform or choice")
    for place, name in shown:
        try:
            check_names([name], known)
        except TwinError as error:
            yield TwinError(place, f"{name}: {error.problem}", error.allowed)
    if study.seek is not None:
        spread = study.vary.get(study.seek)
        if spread is None or not all(isinstance(value, int | float) for value in spread.values):
            yield TwinError("seek", f"{study.seek!r} does not vary as a number", "a key of [vary] with numbers")
        if study.probability is None:
            yield TwinError("seek", "no probability is required", "require.probability")
    if study.probability is not None and not 0 <= study.probability <= 1:
        yield TwinError("require.probability", f"{study.probability:g}: not allowed", "0 to 1")
