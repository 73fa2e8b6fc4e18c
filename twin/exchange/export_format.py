"""A format of `twin export`: description, needed contents, and the function that writes it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Literal, NamedTuple

from twin.exchange.run_contents import RunContents

#: Contents that a format may need: images (of the left camera), pairs (images of both cameras), poses (a true or a
#: final trajectory), map, truth (a true trajectory), world (true layers, for which the world is rendered again).
Need = Literal["images", "pairs", "poses", "map", "truth", "world"]


class ExportFormat(NamedTuple):
    """A format of `twin export`.

    Args:
        description: one line for the list of formats.
        needs: contents without which the format cannot be written.
        write: function that writes the contents to an existing folder and returns the written files, or the folders
            with many written files. It imports the libraries that it needs only when it is called.
    """

    description: str
    needs: frozenset[Need]
    write: Callable[[RunContents, Path], list[Path]]
