"""Which candidates to try next: Optuna's multi-objective TPE sampler, its trials in a journal on disk."""

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
from twin.study.spread import Spread
from twin.study.study_file import Study, Tuning

NAME = "twin"  #: of the study in the journal


class Proposal(NamedTuple):
    """A candidate to fly."""

    number: int
    values: dict[str, Any]
    trial: Trial


class Search:
    """The trials of a search, in `optuna.journal` of a folder: other programs may read it while the search goes on."""

    def __init__(self, study: Study, plan: Tuning, folder: Path):
        """Begins a search, or goes on with it.

        Raises:
            TwinError: the journal belongs to another search.
        """
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        self.plan, self.seed = plan, study.sampling.seed
        self.axes = {key: _axis(spread) for key, spread in plan.search.items()}
        self.trials = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(folder / "optuna.journal"))),
            study_name=NAME,
            directions=["maximize" if more_is_better(name) else "minimize" for name in plan.objectives],
            load_if_exists=True,
        )
        longer = {"tune": {"trials", "confirm"}}  # a search may go on beyond what it began with
        identity = study.model_dump_json(exclude=longer | {"timeout_s": True, "retries": True})  # pyright: ignore
        if self.trials.user_attrs.get("identity", identity) != identity:
            raise TwinError("--resume", f"{folder} holds another search", "the study that it began with")
        self.trials.set_user_attr("identity", identity)

    def next(self) -> list[Proposal]:
        """The candidates to fly next: those left unfinished, else a batch chosen from what is known; none at the end.

        A batch depends on the trials before it alone, not on the number of workers nor on interruptions.
        """
        known = self.trials.get_trials(deepcopy=False)
        if left := [trial for trial in known if trial.state == TrialState.RUNNING]:
            return [_proposal(Trial(self.trials, trial._trial_id)) for trial in left]
        self.trials.sampler = TPESampler(seed=self.seed + len(known), multivariate=True)
        count = min(self.plan.batch, self.plan.trials - len(known))
        return [_proposal(self.trials.ask(self.axes)) for _ in range(count)]

    def finished(self) -> list[tuple[int, dict[str, Any]]]:
        """Number and values of every candidate that was told."""
        done = self.trials.get_trials(deepcopy=False, states=[TrialState.COMPLETE])
        return [(trial.number, dict(trial.params)) for trial in done]

    def tell(self, proposal: Proposal, objectives: Sequence[float], lack: float) -> None:
        """What came of a candidate.

        Args:
            lack: what the share of surveys that pass lacks of the required one; at most 0 is enough.
        """
        proposal.trial.set_constraint("lack", lack)
        self.trials.tell(proposal.trial, list(objectives))


def _axis(spread: Spread) -> BaseDistribution:
    if spread.kind == "choice":
        return CategoricalDistribution(spread.values)
    return FloatDistribution(*spread.values, log=spread.kind == "log_uniform")


def _proposal(trial: Trial) -> Proposal:
    return Proposal(trial.number, dict(trial.params), trial)
