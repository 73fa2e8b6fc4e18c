"""The readers of data sets: those of this package, and those that other packages register."""

from __future__ import annotations

from importlib.metadata import entry_points
from pathlib import Path

from twin.datasets.dataset import Dataset, Reader
from twin.datasets.euroc import EurocReader
from twin.datasets.kitti import KittiReader
from twin.datasets.plain_folder import PlainFolderReader
from twin.errors import TwinError

#: Group of entry points under which another package registers a reader: a class without arguments (`dataset.Reader`).
ENTRY_POINTS = "twin.readers"


def all_readers() -> list[Reader]:
    """Returns the readers that other packages register, then those of this package.

    Raises:
        TwinError: a registered reader cannot be imported.
    """
    return [*_registered(), EurocReader(), KittiReader(), PlainFolderReader()]


def _registered() -> list[Reader]:
    """Returns the readers that other packages register."""
    found: list[Reader] = []
    for entry in entry_points(group=ENTRY_POINTS):
        try:
            found.append(entry.load()())
        except Exception as error:  # any error of code that is not ours
            raise TwinError(f"{ENTRY_POINTS} {entry.name}", f"{entry.value}: {error!r}", "a reader") from None
    return found


def read_dataset(folder: Path) -> tuple[Dataset, str]:
    """Returns the data set in a folder and the name of its reader.

    Raises:
        TwinError: the folder is empty or has no known layout, or a file of the data set is damaged.
    """
    if not folder.is_dir():
        raise TwinError(str(folder), "is not a folder", "the folder of a data set")
    if not any(folder.iterdir()):
        raise TwinError(str(folder), "is empty", "the folder of a data set")
    readers = all_readers()
    for reader in readers:
        if reader.recognises(folder):
            dataset = reader.read(folder)
            if not dataset.images:
                raise TwinError(str(folder), "has no images of the left camera", reader.layout)
            return dataset, reader.name
    layouts = "; ".join(f"{reader.name}: {reader.layout}" for reader in readers)
    raise TwinError(str(folder), "has no layout that a reader knows", layouts)
