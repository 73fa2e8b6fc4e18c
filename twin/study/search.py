"""Multi-objective search with Optuna's TPE sampler; its trials are stored in a journal file."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.samplers import TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import Trial, TrialState

from twin.errors import TwinError
from twin.judge.require import more_is_better
from twin.study.distribution import Distribution
from twin.study.study_file import Study, TuningConfig

NAME = "twin"  #: name of the Optuna study in the journal


class Proposal(NamedTuple):
    """A candidate to evaluate: trial number, value of each searched key, and the Optuna trial."""

    number: int
    values: dict[str, Any]
    trial: Trial


class Search:
    """Search for the best plans; stores its trials in `optuna.journal`, which other programs can read meanwhile."""

    def __init__(self, study: Study, config: TuningConfig, folder: Path):
        """Starts a search, or continues the search stored in the folder.

        Raises:
            TwinError: the journal belongs to another search.
        """
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.config, self.seed = config, study.sampling.seed
        self.space = {key: _optuna_distribution(distribution) for key, distribution in config.search.items()}
        self.optuna_study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(folder / "optuna.journal"))),
            study_name=NAME,
            directions=["maximize" if more_is_better(name) else "minimize" for name in config.objectives],
            load_if_exists=True,
        )
        extendable = {"tune": {"trials", "confirm"}}  # may change when a search is continued
        identity = study.model_dump_json(exclude=extendable | {"timeout_s": True, "retries": True})  # pyright: ignore
        if self.optuna_study.user_attrs.get("identity", identity) != identity:
            raise TwinError("--resume", f"{folder} contains another search", "the folder of this search")
        self.optuna_study.set_user_attr("identity", identity)

    def next_batch(self) -> list[Proposal]:
        """Returns the unfinished candidates of an interrupted search, or else a new batch; [] after the last trial.

        A batch depends only on the earlier trials, not on the number of workers or on interruptions.
        """
        known = self.optuna_study.get_trials(deepcopy=False)
        if unfinished := [trial for trial in known if trial.state == TrialState.RUNNING]:
            return [_proposal(Trial(self.optuna_study, trial._trial_id)) for trial in unfinished]
        self.optuna_study.sampler = TPESampler(seed=self.seed + len(known), multivariate=True)
        count = min(self.config.batch, self.config.trials - len(known))
        return [_proposal(self.optuna_study.ask(self.space)) for _ in range(count)]

    def finished(self) -> list[tuple[int, dict[str, Any]]]:
        """Returns the trial number and the values of the searched keys of every evaluated candidate."""
        complete = self.optuna_study.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
        return [(trial.number, dict(trial.params)) for trial in complete]

    def record(self, proposal: Proposal, objectives: Sequence[float], shortfall: float) -> None:
        """Records the evaluation of a candidate.

        Args:
            proposal: the candidate.
            objectives: value of each objective.
            shortfall: required minus achieved pass probability; 0 or negative if the candidate is feasible.
        """
        proposal.trial.set_constraint("shortfall", shortfall)
        self.optuna_study.tell(proposal.trial, list(objectives))


def _optuna_distribution(distribution: Distribution) -> BaseDistribution:
    if distribution.kind == "choice":
        return CategoricalDistribution(distribution.values)
    return FloatDistribution(*distribution.values, log=distribution.kind == "log_uniform")


def _proposal(trial: Trial) -> Proposal:
    return Proposal(trial.number, dict(trial.params), trial)
