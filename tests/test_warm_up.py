"""Compilation ahead: done once for the same sources; a failure leaves no stamp."""

import subprocess
import types

import numpy as np
import pytest

from twin import warm_up


@pytest.fixture
def started(monkeypatch, tmp_path):
    """Commands of the processes that were started, none of which does anything; `started.status` is how they end."""
    monkeypatch.setenv("NUMBA_CACHE_DIR", str(tmp_path))
    found = types.SimpleNamespace(commands=[], status=0)

    def start(command, **_):
        found.commands.append(command)
        return types.SimpleNamespace(poll=lambda: found.status, returncode=found.status)

    monkeypatch.setattr(subprocess, "Popen", start)
    return found


def test_the_kernels_of_the_same_sources_are_compiled_once(started, monkeypatch, capsys):
    assert (warm_up.main(), warm_up.main(), len(started.commands)) == (0, 0, 2)
    assert capsys.readouterr().err.count("Compiled kernels") == 1
    monkeypatch.setattr(warm_up, "source_hash", lambda _: "of an edited source")
    assert (warm_up.main(), len(started.commands)) == (0, 4)


def test_a_failed_process_is_repeated(started):
    started.status = 1
    assert warm_up.main() == 1
    started.status = 0
    assert (warm_up.main(), len(started.commands)) == (0, 4)


@pytest.mark.long
def test_the_estimators_reach_their_last_stage(tmp_path):
    """The floor is flat, at the altitude of the survey below the start."""
    found = warm_up.estimators(tmp_path)
    assert found is not None
    assert np.nanstd(found.height_m) < 0.01
