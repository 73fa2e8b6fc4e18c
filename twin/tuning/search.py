"""Multi-objective search with Optuna's TPE sampler (tree-structured Parzen estimator); stores trials in a journal."""

from collections.abc import Iterable, Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import optuna
from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution
from optuna.samplers import TPESampler
from optuna.storages import JournalStorage
from optuna.storages.journal import JournalFileBackend
from optuna.trial import FrozenTrial, Trial, TrialState, create_trial

from twin.errors import TwinError
from twin.judge.verdict import more_is_better
from twin.studies.results_log import JOURNAL_FILE, cut_torn_line
from twin.studies.study_file import Study, TuningConfig

NAME = "twin"  #: name of the Optuna study of the first round in the journal
ROUND_NUMBERS = 1_000_000  #: offset between the candidate numbers of successive rounds
_EARLIER = "earlier_round"  # marks the trials that were added from earlier rounds
_EXTENDABLE = {"trials", "confirm", "verify", "plans", "rounds", "keep", "timeout_s"}  # may change on --resume


class Search:
    """Search for the best plans; stores its trials in `optuna.journal`, which other programs can read while it runs.

    A search that is stored in the folder is continued. `fingerprint` is the hash of the scenario with the original
    plan. A further round, from 1, begins with the candidates given to `add_earlier_candidates`. Raises TwinError if the
    journal belongs to another search, or the scenario file was changed.
    """

    def __init__(self, study: Study, config: TuningConfig, folder: Path, fingerprint: str, search_round: int = 0):
        optuna.logging.set_verbosity(optuna.logging.ERROR)
        cut_torn_line(folder / JOURNAL_FILE)
        (folder / f"{JOURNAL_FILE}.lock").unlink(missing_ok=True)  # of a process that was killed: the folder is locked
        self.config, self.seed, self.first_number = config, study.sampling.seed, search_round * ROUND_NUMBERS
        further = max(min(config.batch, config.trials), config.trials // 4)  # candidates of a further round
        self.n_trials = further if search_round else config.trials
        self.space: dict[str, BaseDistribution] = {
            key: CategoricalDistribution(law.values)
            if law.kind == "choice"
            else FloatDistribution(*law.values, log=law.kind == "log_uniform")
            for key, law in config.search.items()
        }
        self.optuna_study = optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(folder / JOURNAL_FILE))),
            study_name=f"{NAME}-round-{search_round}" if search_round else NAME,
            directions=["maximize" if more_is_better(name) else "minimize" for name in config.objectives],
            load_if_exists=True,
        )
        identity = study.model_dump_json(exclude={"tune": _EXTENDABLE, "timeout_s": True, "retries": True})  # pyright: ignore
        attributes = self.optuna_study.user_attrs
        if attributes.get("identity", identity) != identity:
            raise TwinError("--resume", f"{folder} contains another search", "the folder of this search")
        if attributes.get("scenario", fingerprint) != fingerprint:
            problem = f"{folder} contains a search with another scenario: {study.scenario_file} was changed"
            raise TwinError("--resume", problem, "the scenario of this search, or a new folder")
        self.optuna_study.set_user_attr("identity", identity)
        self.optuna_study.set_user_attr("scenario", fingerprint)

    def add_earlier_candidates(self, candidates: Iterable[tuple[dict[str, Any], Sequence[float], float]]) -> None:
        """Adds earlier rounds' (values of searched keys, objectives, shortfall), unless this round has its own."""
        # those that an interrupted search has not added; they have the same order at every call
        known = self._trials()
        if any(_EARLIER not in trial.user_attrs for trial in known):
            return
        for values, objectives, shortfall in islice(candidates, len(known), None):
            trial = create_trial(
                params=values, distributions=self.space, values=list(objectives), constraints={"shortfall": shortfall},
                user_attrs={_EARLIER: True},
            )  # fmt: skip
            self.optuna_study.add_trial(trial)

    def next_batch(self) -> dict[int, Trial]:
        """Returns the candidates to evaluate next, by number; none after the last trial of this round.

        They are those that an interrupted search left unfinished, with the rest of their batch, or a new batch. Each
        depends only on the trials evaluated before its batch, its number and the seed of the study.
        """
        known = self._trials()
        batch = [Trial(self.optuna_study, trial._trial_id) for trial in known if trial.state == TrialState.RUNNING]
        own = sum(_EARLIER not in trial.user_attrs for trial in known)
        wanted = -own % self.config.batch if batch else self.config.batch  # of a batch that was begun, the rest
        for k in range(min(wanted, self.n_trials - own)):
            self.optuna_study.sampler = TPESampler(seed=self.seed + len(known) + k, multivariate=True)
            batch.append(self.optuna_study.ask(self.space))
        return {self.first_number + trial.number: trial for trial in batch}

    def record(self, trial: Trial, objectives: Sequence[float], shortfall: float) -> None:
        """Records the evaluation of a candidate; `shortfall` is the required minus the achieved pass probability."""
        trial.set_constraint("shortfall", shortfall)
        self.optuna_study.tell(trial, list(objectives))

    def finished(self) -> dict[int, dict[str, Any]]:
        """Returns the values of the searched keys of every candidate evaluated in this round, by number."""
        complete = [trial for trial in self._trials() if trial.state == TrialState.COMPLETE]
        return {self.first_number + t.number: dict(t.params) for t in complete if _EARLIER not in t.user_attrs}

    def _trials(self) -> list[FrozenTrial]:
        return self.optuna_study.get_trials(deepcopy=False)
