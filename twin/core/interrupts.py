"""Handling of interrupts (Ctrl-C, SIGTERM), which end only the current stage of a survey; later stages still run."""

import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import FrameType
from typing import Any, Self, TypeVar

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
#: Exit status after Ctrl-C and after SIGTERM: 128 plus the number of the signal, as in a shell.
INTERRUPTED, TERMINATED = 128 + signal.SIGINT, 128 + signal.SIGTERM
T = TypeVar("T")


class StageGuard:
    """Context manager that delivers interrupts only within a stage.

    One that arrives between two stages is delivered at the start of the second, to the handler installed when the
    context was entered. Signals without a Python handler, and threads other than the main one, are not affected.
    """

    def __init__(self) -> None:
        self.cause, self.skipped = "", list[str]()  # why the caller aborts the survey; names of stages that were ended
        self._open, self._waiting = False, list[int]()
        self._handlers: dict[int, Callable[[int, FrameType | None], Any]] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            handlers = {number: signal.getsignal(number) for number in _SIGNALS}
            self._handlers = {number: handler for number, handler in handlers.items() if callable(handler)}
            for number in self._handlers:
                signal.signal(number, self._receive)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)

    @contextmanager
    def stage(self) -> Iterator[None]:
        """Delivers interrupts within this context, including a pending one that arrived before it."""
        self._open = True
        try:
            if self._waiting:
                self._deliver(self._waiting.pop(), None)
            yield
        except SystemError as error:
            if _is_interrupt(error):
                raise KeyboardInterrupt from error
            raise
        finally:
            self._open = False

    def attempt(self, name: str, function: Callable[[], T]) -> T | None:
        """Returns the result of `function` as a stage; None, with `name` in `skipped`, if an interrupt ends it."""
        try:
            with self.stage():
                return function()
        except KeyboardInterrupt:
            self.skipped.append(name)
            return None

    @property
    def reason(self) -> str:
        """Returns why the survey is aborted, and the skipped stages ("interrupted; map skipped"); "" if not aborted."""
        return f"{self.cause or 'interrupted'}; {', '.join(self.skipped)} skipped" if self.skipped else self.cause

    def _receive(self, number: int, frame: FrameType | None) -> None:
        if self._open:
            self._open = False  # a second signal must not interrupt the handling of the first
            self._deliver(number, frame)
        else:
            self._waiting = [number]

    def _deliver(self, number: int, frame: FrameType | None) -> None:
        self._handlers[number](number, frame)


def _is_interrupt(error: BaseException | None) -> bool:
    """Returns whether an interrupt caused an error: compiled code that is being loaded turns it into a SystemError."""
    while error is not None and not isinstance(error, KeyboardInterrupt):
        error = error.__cause__ or error.__context__
    return error is not None


@contextmanager
def sigterm_as_interrupt() -> Iterator[None]:
    """Raises KeyboardInterrupt at a SIGTERM in this context (main thread only), and exits with 143 instead of 130."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    received = False

    def interrupt(number: int, frame: FrameType | None) -> None:
        nonlocal received
        received = True
        raise KeyboardInterrupt

    previous = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    except SystemExit as end:
        if received and end.code == INTERRUPTED:
            sys.exit(TERMINATED)
        raise
    finally:
        signal.signal(signal.SIGTERM, previous)
