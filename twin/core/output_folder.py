"""Output folders: one process at a time writes a folder, and results are not mixed with what it already contains."""

import errno
import os
import platform
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from twin.core.user_files import path_problem
from twin.errors import TwinError

LOCK_FILE = ".lock"  #: is in a folder while this is written, and names the process
_HELD = (errno.EACCES, errno.EAGAIN, errno.EDEADLK)  # of an attempt to lock what another process has locked
_FREE = "another folder, or without its file .lock if that process has ended"
_LOCKED_BYTE = 1 << 20  # on Windows, which lets no other process read a locked byte
NEW_FOLDER = "a new or an empty folder"


@contextmanager
def sole_writer(folder: Path, option: str = "--out", used: bool = False, allowed: str = NEW_FOLDER) -> Iterator[None]:
    """Creates a folder and locks it against other writers until the context ends.

    The operating system releases the lock when the process ends, in whatever way. Folders that were created here and
    are empty at the end are removed. Raises TwinError with the field `option` if another context holds the folder (the
    message names its process), it has contents and is not `used` (the error allows `allowed`), or it cannot be written.
    """
    check_folder(folder, option, used, allowed)
    created = [path for path in (folder, *folder.parents) if not path.exists()]
    try:
        lock = _locked(folder, option)
    except OSError as error:
        raise TwinError(option, f"{folder} cannot be written: {error.strerror or error}", "a writable folder") from None
    try:
        if not used and os.listdir(folder) != [LOCK_FILE]:
            raise TwinError(option, f"{folder} is not empty", allowed)
        yield
    finally:
        _release(lock, folder / LOCK_FILE)
        for path in created:
            with suppress(OSError):  # not empty
                path.rmdir()


def check_folder(folder: Path, option: str = "--out", used: bool = False, allowed: str = NEW_FOLDER) -> None:
    """Raises TwinError if a path cannot be that of a folder, or if it has contents and `used` is False.

    A folder with a lock file may have contents: only an attempt to lock it shows whether it is being written.
    """
    check_path(folder, option, allowed)
    if folder.exists() and not folder.is_dir():
        raise TwinError(option, f"{folder} is not a folder", allowed)
    if not used and not is_empty(folder, option) and not (folder / LOCK_FILE).exists():
        raise TwinError(option, f"{folder} is not empty", allowed)


def is_empty(folder: Path, option: str = "--out") -> bool:
    """Returns whether a folder has no contents or does not exist; raises TwinError if it may not be read."""
    try:
        return not folder.exists() or not any(folder.iterdir())
    except OSError as error:
        raise TwinError(option, f"{folder} cannot be read: {error.strerror}", "a folder of your own") from None


def check_path(path: Path, option: str, allowed: str) -> None:
    if problem := path_problem(path):
        shown = str(path) if len(str(path)) <= 200 else f"{str(path)[:100]}..."
        raise TwinError(option, f"{ascii(shown)}: {problem}", allowed)


def _locked(folder: Path, option: str) -> int:
    file = folder / LOCK_FILE
    while True:
        folder.mkdir(parents=True, exist_ok=True)
        lock = os.open(file, os.O_RDWR | os.O_CREAT, 0o666)
        try:
            if not _lock(lock):
                owner = os.read(lock, 200).decode(errors="replace") or "another process"
                raise TwinError(option, f"{folder} is being written by {owner}", _FREE)
            if file.exists() and os.path.samestat(os.fstat(lock), file.stat()):  # else its last owner removed it
                started = time.strftime("%Y-%m-%d %H:%M:%S")
                os.write(lock, f"process {os.getpid()} on {platform.node()} since {started}".encode())
                return lock
        except BaseException:
            os.close(lock)
            raise
        os.close(lock)


def _lock(lock: int) -> bool:
    """Returns whether the lock of a file was free and now belongs to this descriptor."""
    try:
        if sys.platform == "win32":
            import msvcrt

            os.lseek(lock, _LOCKED_BYTE, os.SEEK_SET)
            try:
                msvcrt.locking(lock, msvcrt.LK_NBLCK, 1)
            finally:
                os.lseek(lock, 0, os.SEEK_SET)
        else:
            import fcntl

            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        # a file system without locks: whoever finds no name in the file writes its own
        return error.errno not in _HELD and os.fstat(lock).st_size == 0
    os.ftruncate(lock, 0)
    return True


def _release(lock: int, file: Path) -> None:
    with suppress(OSError):  # Windows removes no open file; elsewhere no other process may lock it before it is removed
        file.unlink()
    os.close(lock)
    with suppress(OSError):
        if sys.platform == "win32":
            file.unlink()
