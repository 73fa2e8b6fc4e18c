"""Output folders: one writer at a time, no second result over the first, no lock that outlives its process."""

import errno
import fcntl
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

import twin
from twin.app import outputs
from twin.core.output_folder import LOCK_FILE, sole_writer
from twin.errors import TwinError
from twin.studies.runner import open_folder

HOLDER = """
import sys
from pathlib import Path
from twin.core.output_folder import sole_writer
with sole_writer(Path(sys.argv[1])):
    print("held", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def holder(tmp_path):
    """A process that writes the folder `out` until its standard input ends."""
    command = [sys.executable, "-c", HOLDER, str(tmp_path / "out")]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        yield process
        process.stdin.close()


def refusal(folder, **options):
    with pytest.raises(TwinError) as error, sole_writer(folder, **options):
        pass
    return str(error.value)


def test_a_folder_that_another_process_writes_is_refused_with_its_owner(holder, tmp_path):
    for used in (False, True):
        message = refusal(tmp_path / "out", used=used)
        assert f"is being written by process {holder.pid} on {os.uname().nodename} since 20" in message
        assert "\n" not in message
    holder.stdin.close()
    assert holder.wait() == 0
    with sole_writer(tmp_path / "out"):
        pass


def test_the_lock_of_a_killed_process_does_not_block(holder, tmp_path):
    holder.send_signal(signal.SIGKILL)
    holder.wait()
    assert (tmp_path / "out" / LOCK_FILE).exists()
    with sole_writer(tmp_path / "out"):
        assert str(os.getpid()) in (tmp_path / "out" / LOCK_FILE).read_text()
    assert not (tmp_path / "out" / LOCK_FILE).exists()


def test_two_writers_in_one_process_exclude_each_other(tmp_path):
    with sole_writer(tmp_path / "out"):
        assert f"process {os.getpid()} on" in refusal(tmp_path / "out")


def test_a_used_folder_is_refused_unless_it_may_be_used(tmp_path):
    (tmp_path / "metrics.json").touch()
    assert refusal(tmp_path) == f"--out: {tmp_path} is not empty (allowed: a new or an empty folder)"
    with sole_writer(tmp_path, used=True):
        pass
    assert os.listdir(tmp_path) == ["metrics.json"]


def test_a_folder_without_results_is_removed_with_those_above_it(tmp_path):
    with pytest.raises(ZeroDivisionError), sole_writer(tmp_path / "runs" / "one"):
        raise ZeroDivisionError
    assert not os.listdir(tmp_path)
    with sole_writer(tmp_path / "runs" / "one"):
        (tmp_path / "runs" / "one" / "result").touch()
    assert os.listdir(tmp_path / "runs" / "one") == ["result"]


def test_a_folder_that_cannot_be_written_is_refused_in_one_line():
    message = refusal(Path("/proc/twin"))
    assert message.startswith("--out: /proc/twin cannot be written: ") and "\n" not in message


def test_on_a_file_system_without_locks_the_name_in_the_file_is_the_lock(tmp_path, monkeypatch):
    def no_locks(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", no_locks)
    with sole_writer(tmp_path / "out"):
        assert f"process {os.getpid()} on" in refusal(tmp_path / "out")
    with sole_writer(tmp_path / "out"):
        pass


@pytest.mark.parametrize("write", [twin.run, twin.replay])
def test_python_refuses_a_used_folder_as_the_command_line_does(tmp_path, write):
    (tmp_path / "old.png").touch()
    with pytest.raises(TwinError, match=f"--out: {tmp_path} is not empty"):
        write(twin.load_scenario("quickstart") if write is twin.run else tmp_path, tmp_path)
    assert os.listdir(tmp_path) == ["old.png"]


ROW = '{"sample": 0, "seed": 1, "status": "complete", "scenario_hash": "", "reason": ""}\n'
STUDY = {"rows.jsonl": ROW, "runs/00000_s1/metrics.json": ""}
SEARCH = STUDY | {"optuna.journal": ""}
RUN = {"log.jsonl": "", "metrics.json": ""}
PROJECT = {"runs/quickstart-1/metrics.json": "", "runs/.hidden/file": ""}


@pytest.mark.parametrize(
    ("search", "files", "own"),
    [
        *((search, files, False) for search in (False, True) for files in (RUN, PROJECT)),
        (False, STUDY, True),
        (True, STUDY, False),
        (False, SEARCH, False),
        (True, SEARCH, True),
        (False, {"rows.jsonl": ""}, True),
        (True, {"rows.jsonl": ""}, True),
    ],
)
def test_resume_refuses_a_folder_of_another_kind_and_keeps_its_files(tmp_path, search, files, own):
    for name, text in files.items():
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).write_text(text)
    if own:
        with open_folder(tmp_path, resume=True, search=search):
            return
    kind = "search" if search else "study"
    with pytest.raises(TwinError, match=f"^--resume: {tmp_path} is not the folder of a {kind} "):
        open_folder(tmp_path, resume=True, search=search).__enter__()
    assert {name: (tmp_path / name).read_text() for name in files} == files


def test_a_folder_that_may_not_be_read_is_one_line(tmp_path, monkeypatch):
    def iterdir(folder):
        raise PermissionError(errno.EACCES, "Permission denied", str(folder))

    monkeypatch.setattr(Path, "iterdir", iterdir)
    assert refusal(tmp_path) == f"--out: {tmp_path} cannot be read: Permission denied (allowed: a folder of your own)"
    with pytest.raises(TwinError, match="cannot be read: Permission denied"):
        outputs.unused_folder(tmp_path)
