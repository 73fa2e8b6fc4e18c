"""Checkpoints of a run on disk: its state, from which it continues after its process was killed.

A state is a pickle, and reading a pickle can run any code. Its hash, which is checked before it is read, shows damage,
not malice: resume only in a folder that nobody else can write.
"""

from __future__ import annotations

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

    Args:
        run: the run folder.
        identity: texts, by name, on which the results of the run depend: a state is of a run with the same ones.
        inputs: files that the run reads, for the same purpose.
        interval_s: wall time between checkpoints [s]; 0: none are saved; None: `DEFAULT_S`, or so much that they take
            1 % of the time.
    """

    def __init__(
        self, run: Path, identity: Mapping[str, str], inputs: Iterable[Path] = (), interval_s: float | None = None
    ):
        if interval_s is not None and not interval_s >= 0:
            raise TwinError("checkpoint_s", f"{interval_s} s is no time between checkpoints", "0 or more")
        self._run, self._folder, self._manifest = run, run / FOLDER, run / FOLDER / "manifest.json"
        self._contents: dict[str, Any] = {"schema": SCHEMA, "identity": dict(identity), "state": None}
        self._inputs = sorted(set(inputs))
        self._is_default, self._interval_s = interval_s is None, DEFAULT_S if interval_s is None else interval_s
        self._start_s = self._last_s = time.perf_counter()
        self._number = 0
        self.problem = ""  #: why the last state could not be saved

    def begin(self) -> None:
        """Creates the folder, with a manifest without a state, unless no checkpoints are to be saved."""
        if not self._interval_s:
            return
        self._contents |= {"state": None, "inputs": self._hashes()}
        with suppress(OSError):  # `save` will say why
            self._folder.mkdir(parents=True, exist_ok=True)
            self._write_manifest()

    def _hashes(self) -> dict[str, str]:
        return {str(file): file_hash(file) for file in self._inputs}

    def load(self, made_anew: Sequence[object]) -> Any:
        """Returns the last state; None if the run was killed before the first one.

        `made_anew` are the objects that replace those of `save`, in the same order. Raises TwinError if manifest, state
        or a file on which the state depends was edited or is damaged, or they belong to another run or program, or the
        folder of the run has other contents and no checkpoint.
        """
        if not is_file(self._manifest):
            if {file.name for file in self._run.iterdir()} - {LOCK_FILE, FOLDER}:
                raise TwinError("--resume", f"{self._run} has no checkpoint", "the folder of a run that was killed")
            return None
        self._contents["inputs"] = self._hashes()
        found = read_json(self._manifest, allowed=_WHOLE)
        if not isinstance(found, dict) or found.get("schema") != SCHEMA:
            raise self._refused(self._manifest, f"has not the schema {SCHEMA}", _SAME)
        for part, what in (("identity", "{}: was {}, is {}"), ("inputs", "the file {} has changed")):
            before, now = found.get(part), self._contents[part]
            if not isinstance(before, dict) or before.keys() != now.keys():
                raise self._refused(self._manifest, f"has other {part}", _SAME)
            for name in now:
                if before[name] != now[name]:
                    raise self._refused(self._manifest, what.format(name, before[name], now[name]), _SAME)
        if (state := found.get("state")) is None:
            return None
        try:
            file, self._number = self._folder / Path(state["file"]).name, int(state["number"])
            check_hash(file, state["sha256"])
        except (KeyError, TypeError, ValueError):
            raise self._refused(self._manifest, "names no state", _WHOLE) from None
        self._contents["state"] = state
        with file.open("rb") as stream:
            try:
                return _Reader(stream, self._run, made_anew).load()
            except TwinError:
                raise
            except Exception as error:  # code or packages that the identity does not tell apart
                raise self._refused(file, f"cannot be read: {error}", _SAME) from error

    @staticmethod
    def _refused(file: Path, problem: str, allowed: str) -> TwinError:
        return TwinError(str(file), problem, allowed)

    @property
    def due(self) -> bool:
        return bool(self._interval_s) and time.perf_counter() - self._last_s >= self._interval_s

    @property
    def last_due(self) -> bool:
        """Returns whether the state after the last frame is to be saved: the run has taken longer than the interval."""
        return bool(self._interval_s) and time.perf_counter() - self._start_s >= self._interval_s

    def save(self, state: object, made_anew: Sequence[object]) -> None:
        """Saves a state, without the objects `made_anew`, which follow from the scenario alone.

        If this fails, the last state is kept, and `problem` says why.
        """
        start_s, old = time.perf_counter(), self._contents["state"]
        try:
            self._save(state, made_anew)
            self.problem = ""
        except (OSError, MemoryError, pickle.PicklingError, TypeError, AttributeError) as error:  # the last three: a
            self._contents["state"], self.problem = old, str(error) or type(error).__name__  # plug-in's own objects
        kept = {self._manifest.name, (self._contents["state"] or {}).get("file")}
        for file in self._folder.iterdir() if self._folder.is_dir() else ():
            if file.name not in kept:
                with suppress(OSError):
                    file.unlink()
        self._last_s = time.perf_counter()
        if self._is_default:
            self._interval_s = max(DEFAULT_S, (self._last_s - start_s) / _MOST_SHARE)

    def _save(self, state: object, made_anew: Sequence[object]) -> None:
        name, hashed = f"state-{self._number + 1}.pickle", hashlib.sha256()

        def write(stream: IO[bytes]) -> None:
            _Writer(stream, hashed, self._run, made_anew).dump(state)

        _replace(self._folder / name, write)
        self._number += 1
        self._contents["state"] = {"file": name, "number": self._number, "sha256": hashed.hexdigest()}
        self._write_manifest()

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

    def __init__(self, stream: IO[bytes], hashed: Any, run: Path, made_anew: Sequence[object]):
        super().__init__(_Hashing(stream, hashed), pickle.HIGHEST_PROTOCOL)
        self._run = run
        self._numbers = {id(one): number for number, one in enumerate(made_anew) if one is not None}

    def persistent_id(self, obj: Any) -> Any:
        if isinstance(obj, Path) and obj.is_relative_to(self._run):
            return str(obj.relative_to(self._run))
        return self._numbers.get(id(obj))


class _Hashing:
    """Stream whose bytes are also hashed."""

    def __init__(self, stream: IO[bytes], hashed: Any):
        self._stream, self._hashed = stream, hashed

    def write(self, data: Any) -> int:
        self._hashed.update(data)
        return self._stream.write(data)


class _Reader(pickle.Unpickler):
    def __init__(self, stream: IO[bytes], run: Path, made_anew: Sequence[object]):
        super().__init__(stream)
        self._run, self._made_anew = run, made_anew

    def persistent_load(self, pid: Any) -> Any:
        return self._run / pid if isinstance(pid, str) else self._made_anew[pid]
