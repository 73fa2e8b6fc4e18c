"""Every task has an outcome, whatever happens to the task or its process, and no failure affects another task."""

import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ThreadPoolExecutor

import pytest
import study_tasks

from twin.engines.engine import LocalEngine, open_engine
from twin.engines.worker import OUT_OF_TIME, TaskLimits, WorkerPool
from twin.errors import EngineLostError, TwinError


@pytest.fixture(scope="module")
def engine():
    with open_engine(jobs=2) as engine:
        yield engine


def outcomes(engine, tasks, limits, function=study_tasks.misbehave):
    return {outcome.task: outcome for outcome in engine.run_many(function, tasks, limits)}


def test_every_task_returns_its_result(engine):
    by_task = outcomes(engine, range(40), TaskLimits(), study_tasks.square)
    assert {task: (o.result, o.failure, o.attempts) for task, o in by_task.items()} == {
        k: (k * k, "", 1) for k in range(40)
    }


def test_each_worker_is_pinned_to_one_core(engine):
    results = [o.result for o in engine.run_many(study_tasks.process_and_cores, range(8), TaskLimits())]
    assert all(len(cores) == 1 for _, cores in results)
    n = min(2, len(os.sched_getaffinity(0)), len({pid for pid, _ in results}))
    assert len(set().union(*(cores for _, cores in results))) == n


def test_a_task_that_raises_fails_with_its_exception_and_source_line(engine):
    by_task = outcomes(engine, [("raise", ""), ("go", "")], TaskLimits())
    failed = by_task["raise", ""]
    assert failed.result is None
    assert failed.failure.startswith("ValueError: the sea is closed (study_tasks.py:")
    assert failed.attempts == 1  # an exception is not retried
    assert by_task["go", ""].result == "go"


def test_a_task_that_hangs_is_killed_after_its_timeout(engine):
    start = time.monotonic()
    by_task = outcomes(engine, [("hang", ""), ("go", "")], TaskLimits(timeout_s=1.5))
    assert by_task["hang", ""].failure == "did not finish within 1.5 s"
    assert by_task["go", ""].result == "go"
    assert time.monotonic() - start < 20


def test_at_the_end_of_the_time_running_tasks_are_stopped_and_no_more_are_started(engine):
    start = time.monotonic()
    limits = TaskLimits(timeout_s=600, end_s=time.time() + 1.5)
    by_task = outcomes(engine, [("hang", str(k)) for k in range(6)], limits)
    assert [outcome.failure for outcome in by_task.values()] == 6 * [OUT_OF_TIME]
    assert sorted(outcome.attempts for outcome in by_task.values()) == [0, 0, 0, 0, 1, 1]
    assert time.monotonic() - start < 20


def test_a_task_whose_process_is_killed_is_retried_up_to_the_limit(engine, tmp_path):
    once, always = ("die once", str(tmp_path / "once")), ("die", str(tmp_path / "always"))
    by_task = outcomes(engine, [once, always], TaskLimits(retries=1))
    assert (by_task[once].result, by_task[once].attempts) == ("die once", 2)
    assert (by_task[always].failure, by_task[always].attempts) == ("worker process was killed by SIGKILL", 2)


def test_no_result_is_lost_if_a_worker_is_killed_from_outside():
    with open_engine(jobs=2) as engine:
        results = {}
        for outcome in engine.run_many(study_tasks.slow_square, range(10), TaskLimits()):
            if not results:
                busy = next(iter(engine.pool._busy))
                os.kill(busy._process.pid, signal.SIGKILL)
            results[outcome.task] = outcome.result
    assert results == {k: k * k for k in range(10)}


def test_closing_the_iterator_kills_the_workers():
    engine = LocalEngine(1)
    running = engine.run_many(study_tasks.misbehave, [("go", ""), ("hang", ""), ("hang", "")], TaskLimits())
    next(running)
    (worker,) = engine.pool._busy | set(engine.pool._idle)
    running.close()
    with pytest.raises(ProcessLookupError):
        os.kill(worker._process.pid, 0)


def test_a_pipe_is_closed_only_once_when_the_pool_is_closed_during_a_task():
    pool = WorkerPool()
    with ThreadPoolExecutor(1) as threads:
        running = threads.submit(pool.run, study_tasks.misbehave, ("hang", ""), TaskLimits())
        while not pool._busy:
            time.sleep(0.01)
        (worker,) = pool._busy
        closed = []

        def close_slowly():
            closed.append(threading.get_ident())
            time.sleep(0.3)

        worker._pipe._close = close_slowly
        pool.close()
        outcome = running.result(timeout=20)
    assert (outcome.failure, outcome.attempts, len(closed)) == ("worker process was killed by SIGKILL", 1, 1)
    assert pool.run(study_tasks.square, 3, TaskLimits()).failure == "the worker pool is closed"


def test_an_unreachable_scheduler_is_reported(monkeypatch):
    monkeypatch.setattr("twin.engines.dask_engine._CONNECT_TIMEOUT_S", 0.5)
    with pytest.raises(TwinError, match=r"--scheduler: nowhere:1 does not respond: .*e\.g\. tcp://host:8786\)"):
        with open_engine(scheduler="nowhere:1"):
            pass


def test_slurm_jobs_need_dask_jobqueue(monkeypatch):
    monkeypatch.setitem(sys.modules, "dask_jobqueue.slurm", None)
    with pytest.raises(TwinError, match="--scheduler: slurm needs dask-jobqueue, which is not installed"):
        with open_engine(jobs=1, scheduler="slurm"):
            pass


@pytest.mark.long
def test_a_dask_cluster_gives_the_outcomes_of_a_local_engine_even_if_it_loses_a_worker(tmp_path):
    from distributed import LocalCluster

    with LocalCluster(n_workers=2, threads_per_worker=1, dashboard_address=None) as cluster:
        with open_engine(scheduler=cluster.scheduler_address) as engine:
            tasks = [("go", "a"), ("raise", ""), ("die once", str(tmp_path / "x"))]
            by_task = outcomes(engine, tasks, TaskLimits())
            assert by_task["go", "a"].result == "go"
            assert by_task["raise", ""].failure.startswith("ValueError: the sea is closed")
            assert by_task["die once", str(tmp_path / "x")].attempts == 2
            squares = {}
            for outcome in engine.run_many(study_tasks.slow_square, range(20), TaskLimits()):
                if not squares:
                    os.kill(cluster.workers[0].pid, signal.SIGKILL)
                squares[outcome.task] = outcome.result
    assert squares == {k: k * k for k in range(20)}


@pytest.mark.long
def test_a_cluster_that_has_lost_all_workers_for_long_is_given_up(monkeypatch):
    from distributed import LocalCluster

    monkeypatch.setattr("twin.engines.dask_engine._WITHOUT_WORKERS_S", 1.0)
    with LocalCluster(n_workers=1, threads_per_worker=1, dashboard_address=None) as cluster:
        with open_engine(scheduler=cluster.scheduler_address) as engine:
            done = []
            with pytest.raises(EngineLostError, match="all workers were lost for 1 s"):
                for outcome in engine.run_many(study_tasks.slow_square, range(50), TaskLimits()):
                    done.append(outcome.result)
                    cluster.scale(0)
    assert done


def test_workers_end_when_their_parent_process_is_killed():
    script = (
        "import os, signal, study_tasks\n"
        "from twin.engines.engine import LocalEngine, TaskLimits\n"
        "engine = LocalEngine(1)\n"
        "for outcome in engine.run_many(study_tasks.process_and_cores, [0], TaskLimits()):\n"
        "    print(outcome.result[0], flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    folder = os.path.dirname(study_tasks.__file__)
    parent = subprocess.run(
        [sys.executable, "-c", script],
        env=os.environ | {"PYTHONPATH": os.pathsep.join([folder, *sys.path])},
        capture_output=True,
        text=True,
    )
    worker = int(parent.stdout)
    deadline = time.monotonic() + 10
    while time.monotonic() < deadline and os.path.exists(f"/proc/{worker}"):
        time.sleep(0.1)
    assert not os.path.exists(f"/proc/{worker}")
