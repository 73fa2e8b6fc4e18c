"""Whatever happens to a task or to its process: each comes back, and none takes another one down."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import study_tasks

from twin.errors import TwinError
from twin.study.engine import LocalEngine, connect
from twin.study.worker import Crew, Limits


@pytest.fixture(scope="module")
def engine():
    with connect(jobs=2) as engine:
        yield engine


def outcomes(engine, tasks, limits, function=study_tasks.misbehave):
    return {outcome.task: outcome for outcome in engine.run_many(function, tasks, limits)}


def test_every_task_comes_back_with_its_result(engine):
    found = outcomes(engine, range(40), Limits(), study_tasks.square)
    assert {task: (o.result, o.failure, o.attempts) for task, o in found.items()} == {
        k: (k * k, "", 1) for k in range(40)
    }


def test_each_worker_keeps_to_one_processor(engine):
    found = [outcome.result for outcome in engine.run_many(study_tasks.processor, range(8), Limits())]
    assert all(len(processors) == 1 for _, processors in found)
    n = min(2, len(os.sched_getaffinity(0)), len({pid for pid, _ in found}))
    assert len(set().union(*(processors for _, processors in found))) == n


def test_a_task_that_raises_has_failed_with_its_reason_and_place(engine, tmp_path):
    found = outcomes(engine, [("raise", ""), ("go", "")], Limits())
    failed = found["raise", ""]
    assert failed.result is None
    assert failed.failure.startswith("ValueError: the sea is closed (study_tasks.py:")
    assert failed.attempts == 1  # it would raise again
    assert found["go", ""].result == "go"


def test_a_task_that_hangs_is_ended_after_its_time(engine):
    began = time.monotonic()
    found = outcomes(engine, [("hang", ""), ("go", "")], Limits(timeout_s=1.5))
    assert found["hang", ""].failure == "did not end within 1.5 s"
    assert found["go", ""].result == "go"
    assert time.monotonic() - began < 20


def test_a_task_whose_process_is_killed_is_tried_again_and_no_more_often_than_told(engine, tmp_path):
    once, always = ("die once", str(tmp_path / "once")), ("die", str(tmp_path / "always"))
    found = outcomes(engine, [once, always], Limits(retries=1))
    assert (found[once].result, found[once].attempts) == ("die once", 2)
    assert (found[always].failure, found[always].attempts) == ("its process was killed by SIGKILL", 2)


def test_a_worker_killed_from_outside_loses_nothing():
    with connect(jobs=2) as engine:
        found = {}
        for outcome in engine.run_many(study_tasks.slow_square, range(10), Limits()):
            if not found:
                busy = next(iter(engine.crew._busy))
                os.kill(busy._process.pid, signal.SIGKILL)
            found[outcome.task] = outcome.result
    assert found == {k: k * k for k in range(10)}


def test_who_stops_listening_ends_the_workers():
    engine = LocalEngine(1)
    running = engine.run_many(study_tasks.misbehave, [("go", ""), ("hang", ""), ("hang", "")], Limits())
    next(running)
    (worker,) = engine.crew._busy | set(engine.crew._idle)
    running.close()
    with pytest.raises(ProcessLookupError):
        os.kill(worker._process.pid, 0)


def test_a_pipe_is_closed_once_when_a_study_ends_while_its_worker_is_asked():
    crew = Crew()
    with ThreadPoolExecutor(1) as pool:
        asked = pool.submit(crew.work, study_tasks.misbehave, ("hang", ""), Limits())
        while not crew._busy:
            time.sleep(0.01)
        (worker,) = crew._busy
        closed = []

        def close_slowly():
            closed.append(threading.get_ident())
            time.sleep(0.3)

        worker._pipe._close = close_slowly
        crew.end()
        reply, attempts = asked.result(timeout=20)
    assert (reply.kind, attempts, len(closed)) == ("killed", 1, 1)
    assert crew.work(study_tasks.square, 3, Limits())[0].reason == "the study is over"


def test_a_scheduler_that_is_not_there_is_told(monkeypatch):
    monkeypatch.setattr("twin.study.cluster._REACH_S", 0.5)
    with pytest.raises(TwinError, match="--scheduler: nowhere:1 .*(allowed: as tcp://host:8786)"):
        with connect(scheduler="nowhere:1"):
            pass


@pytest.mark.slow
def test_a_dask_cluster_answers_like_this_machine_also_when_it_loses_a_worker(tmp_path):
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        with connect(scheduler=cluster.scheduler_address) as engine:
            found = outcomes(engine, [("go", "a"), ("raise", ""), ("die once", str(tmp_path / "x"))], Limits())
            assert found["go", "a"].result == "go"
            assert found["raise", ""].failure.startswith("ValueError: the sea is closed")
            assert found["die once", str(tmp_path / "x")].attempts == 2
            squares = {}
            for outcome in engine.run_many(study_tasks.slow_square, range(20), Limits()):
                if not squares:
                    os.kill(cluster.workers[0].pid, signal.SIGKILL)
                squares[outcome.task] = outcome.result
    assert squares == {k: k * k for k in range(20)}


def test_workers_end_with_the_program_that_started_them(tmp_path):
    script = (
        "import os, signal, study_tasks\n"
        "from twin.study.engine import LocalEngine, Limits\n"
        "e = LocalEngine(1)\n"
        "for o in e.run_many(study_tasks.processor, [0], Limits()): print(o.result[0], flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    folder = os.path.dirname(study_tasks.__file__)
    said = subprocess.run(
        [sys.executable, "-c", script], env=os.environ | {"PYTHONPATH": folder}, capture_output=True, text=True
    )
    worker = int(said.stdout)
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline and os.path.exists(f"/proc/{worker}"):
        time.sleep(0.1)
    assert not os.path.exists(f"/proc/{worker}")
