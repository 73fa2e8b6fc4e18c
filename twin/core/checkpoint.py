"""Checkpoints of a run on disk: its state, from which it continues after its process was killed.

A state is a pickle, and reading a pickle can run any code. Its hash, which is checked before it is read, shows damage,
not malice: resume only in a folder that nobody else can write.
"""

import hashlib
import json
import os
import pickle
import shutil
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import IO, Any, TextIO

from twin.core.output_folder import LOCK_FILE
from twin.core.user_files import is_file, read_json
from twin.errors import TwinError

FOLDER = "checkpoint"  #: in a run folder while the run is in progress
SCHEMA = "twin.checkpoint/1"
DEFAULT_S = 60.0  #: wall time between checkpoints
_MOST_SHARE = 0.01  # of the wall time that checkpoints may take by default
_SAME = "the checkpoint of the same run; else a new folder"
_WHOLE = "an unedited run folder, or a new one"


class Checkpoints:
    """Checkpoints in the folder `checkpoint` of a run: its last state, and a manifest, which is replaced after it.

    A state is of a run with the same `identity`, texts by name, and the same input files. The wall time between
    checkpoints is `interval_s`; 0: none are saved; None: `DEFAULT_S`, or so much that they take 1 % of the time.
    """

    def __init__(self, run: Path, identity: Mapping[str, str], inputs: Iterable[Path], interval_s: float | None):
        if interval_s is not None and not interval_s >= 0:
            raise TwinError("checkpoint_s", f"{interval_s} s is no time between checkpoints", "0 or more")
        self._run, self._folder, self._manifest = run, run / FOLDER, run / FOLDER / "manifest.json"
        self._contents: dict[str, Any] = {"schema": SCHEMA, "identity": dict(identity), "state": None}
        self._inputs, self._made_anew = inputs, ()
        self._is_default, self._interval_s = interval_s is None, DEFAULT_S if interval_s is None else interval_s
        self._start_s = self._last_s = time.perf_counter()
        self.problem = ""  #: why the last state could not be saved

    def open(self, resume: bool, made_anew: Sequence[object] = ()) -> Any:
        """Returns the last state if the run is to be resumed; None if it begins, or was killed before the first one.

        A state leaves out the objects `made_anew`; they are the same, in the same order, in every process. Raises
        TwinError if manifest, state or a file on which the state depends was edited or is damaged, or they belong to
        another run or program, or the folder has other contents and no checkpoint.
        """
        self._made_anew = made_anew
        if not (resume or self._interval_s):
            return None
        self._contents["inputs"] = {str(file): file_hash(file) for file in sorted(set(self._inputs))}
        if resume and is_file(self._manifest):
            state = self._checked_state()
            if state is not None:
                return self._loaded(state)
        elif resume and {file.name for file in self._run.iterdir()} - {LOCK_FILE, FOLDER}:
            raise TwinError("--resume", f"{self._run} has no checkpoint", "the folder of a run that was killed")
        with suppress(OSError):  # `_save` will say why
            self._folder.mkdir(parents=True, exist_ok=True)
            self._write_manifest()
        return None

    def _checked_state(self) -> Any:
        found, name = read_json(self._manifest, allowed=_WHOLE), str(self._manifest)
        if not isinstance(found, dict) or found.get("schema") != SCHEMA:
            raise TwinError(name, f"has not the schema {SCHEMA}", _SAME)
        for part, what in (("identity", "{}: was {}, is {}"), ("inputs", "the file {} has changed")):
            before, now = found.get(part), self._contents[part]
            if not isinstance(before, dict) or before.keys() != now.keys():
                other = min(before.keys() ^ now.keys()) if isinstance(before, dict) else before
                raise TwinError(name, f"has other {part}: {other}", _SAME)
            for key in now:
                if before[key] != now[key]:
                    raise TwinError(name, what.format(key, before[key], now[key]), _SAME)
        return found.get("state")

    def _loaded(self, state: Any) -> Any:
        try:
            file = self._folder / f"state-{int(state['number'])}.pickle"
            check_hash(file, state["sha256"])
        except (KeyError, TypeError, ValueError):
            raise TwinError(str(self._manifest), "names no state", _WHOLE) from None
        self._contents["state"] = state
        with file.open("rb") as stream:
            try:
                return _Reader(stream, self._run, self._made_anew).load()
            except TwinError:
                raise
            except Exception as error:  # code or packages that the identity does not tell apart
                raise TwinError(str(file), f"cannot be read: {error}", _SAME) from error

    def save_if_due(self, state: object) -> None:
        """Saves a state if the interval has passed since the last one."""
        if self._interval_s and time.perf_counter() - self._last_s >= self._interval_s:
            self._save(state)

    def save_last(self, state: object) -> None:
        """Saves the state before the last stages of the run, unless it has taken less time than the interval so far.

        After a problem, removes the folder: a full disk needs the space for the results.
        """
        if self._interval_s and time.perf_counter() - self._start_s >= self._interval_s:
            self._save(state)
        if self.problem:
            self.remove()

    def _save(self, state: object) -> None:
        """Saves a state; if this fails, the last one is kept, and `problem` says why."""
        start_s, old = time.perf_counter(), self._contents["state"]
        number = old["number"] + 1 if old else 1
        file = self._folder / f"state-{number}.pickle"
        try:
            _replace(file, lambda stream: _Writer(stream, self._run, self._made_anew).dump(state))
            self._contents["state"] = {"number": number, "sha256": file_hash(file)}
            self._write_manifest()
            self.problem = ""
        except Exception as error:  # of the disk, or of an object of a plug-in that cannot be saved: any
            self._contents["state"], self.problem = old, str(error) or type(error).__name__
        kept = f"state-{(self._contents['state'] or {}).get('number')}.pickle"
        for other in self._folder.glob("*"):
            if other not in (self._manifest, self._folder / kept):
                other.unlink(missing_ok=True)
        self._last_s = time.perf_counter()
        if self._is_default:
            self._interval_s = max(DEFAULT_S, (self._last_s - start_s) / _MOST_SHARE)

    def _write_manifest(self) -> None:
        _replace(self._manifest, lambda stream: stream.write(json.dumps(self._contents, indent=1).encode()))

    def remove(self) -> None:
        """Removes the folder; the manifest, without which nothing is resumed, first."""
        self._manifest.unlink(missing_ok=True)
        shutil.rmtree(self._folder, ignore_errors=True)


def file_hash(file: Path) -> str:
    """Returns the SHA-256 of a file; "" if it cannot be read."""
    try:
        with file.open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError:
        return ""


def check_inputs(folder: Path, inputs: Iterable[Path]) -> None:
    """Writes inputs.json, hashes of input files; if it exists, TwinError if one has changed. OSError if unwritable."""
    record = folder / "inputs.json"
    before = read_json(record, allowed=_WHOLE) if is_file(record) else {}
    now = {str(file): file_hash(file) for file in sorted(set(inputs))}
    for name in now:
        if isinstance(before, dict) and before.get(name, now[name]) != now[name]:
            raise TwinError("--resume", f"the file {name} has changed since {record} was written", _SAME)
    if now != before:
        _replace(record, lambda stream: stream.write(json.dumps(now, indent=1).encode()))


def check_hash(file: Path, expected: str) -> None:
    """Raises TwinError if a file on which a checkpoint depends is missing or has another SHA-256."""
    if file_hash(file) != expected:
        problem = "was edited or is damaged" if file.exists() else "is missing"
        raise TwinError(str(file), f"{problem}: the checkpoint depends on it", _WHOLE)


def flushed_length(file: IO[Any]) -> int:
    """Returns the length of a file [bytes] that has been written so far, after a flush."""
    file.flush()
    return os.fstat(file.fileno()).st_size


def reopened(file: Path, length: int) -> TextIO:
    """Opens a text file to write on at a length [bytes]; raises TwinError if it is shorter or missing."""
    if not is_file(file) or file.stat().st_size < length:
        raise TwinError(str(file), "is missing or cut: the checkpoint depends on it", _WHOLE)
    stream = file.open("r+", newline="", encoding="utf-8")
    stream.seek(length)
    stream.truncate()
    return stream


def _replace(file: Path, write: Callable[[IO[bytes]], object]) -> None:
    """Writes a file under a temporary name and renames it when it is on the disk."""
    part = file.with_name(f"{file.name}.part")
    with part.open("wb") as stream:
        write(stream)
        stream.flush()
        os.fsync(stream.fileno())
    part.replace(file)
    if os.name != "nt":  # where a folder cannot be opened
        folder = os.open(file.parent, os.O_RDONLY)
        try:
            os.fsync(folder)
        finally:
            os.close(folder)


class _Writer(pickle.Pickler):
    """Pickler that leaves out the objects `made_anew`, and writes paths in the run folder relative to it."""

    def __init__(self, stream: IO[bytes], run: Path, made_anew: Sequence[object]):
        super().__init__(stream, pickle.HIGHEST_PROTOCOL)
        self._run = run
        self._numbers = {id(one): number for number, one in enumerate(made_anew) if one is not None}

    def persistent_id(self, obj: Any) -> Any:
        if isinstance(obj, Path) and obj.is_relative_to(self._run):
            return str(obj.relative_to(self._run))
        return self._numbers.get(id(obj))


class _Reader(pickle.Unpickler):
    def __init__(self, stream: IO[bytes], run: Path, made_anew: Sequence[object]):
        super().__init__(stream)
        self._run, self._made_anew = run, made_anew

    def persistent_load(self, pid: Any) -> Any:
        return self._run / pid if isinstance(pid, str) else self._made_anew[pid]
