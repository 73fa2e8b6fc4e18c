"""The readers of data sets: those of this package, and those that other packages register."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from twin.core.user_files import path_problem
from twin.datasets.dataset import Dataset, Reader, check_times
from twin.datasets.euroc import EurocReader
from twin.datasets.kitti import KittiReader
from twin.datasets.plain_folder import PlainFolderReader
from twin.datasets.ros2.bag_reader import BagReader, BagTopics
from twin.errors import TwinError
from twin.plugin import loading


def all_readers(topics: BagTopics | None = None) -> list[Reader]:
    """Returns the readers of other packages, then of this one; raises TwinError if one cannot be created or used."""
    foreign = loading.registered(loading.READERS, _ForeignReader)
    return [*foreign, BagReader(topics), EurocReader(), KittiReader(), PlainFolderReader()]


class _ForeignReader:
    """Reader of another package; every exception that it raises becomes a TwinError that names it by `value`."""

    def __init__(self, reader: Reader, value: str):
        self.name, self.layout, self._value = str(reader.name), str(reader.layout), value
        self._recognises, self._read = reader.recognises, reader.read

    def recognises(self, folder: Path) -> bool:
        return bool(self._call(self._recognises, folder))

    def read(self, folder: Path) -> Dataset:
        found = self._call(self._read, folder)
        if not isinstance(found, Dataset):
            problem = f"{self._value} returned {type(found).__name__}"
            raise TwinError(f"{loading.READERS} {self.name}", problem, "twin.datasets.dataset.Dataset")
        return found

    def _call(self, function: Callable[[Path], Any], folder: Path) -> Any:
        try:
            return function(folder)
        except TwinError:
            raise
        except Exception as error:  # any error of code that is not ours
            problem = f"{self._value}: {' '.join(repr(error).split())[:200]}"
            raise TwinError(f"{loading.READERS} {self.name}", problem, "a reader that raises TwinError") from None


def read_dataset(folder: Path, topics: BagTopics | None = None) -> tuple[Dataset, str]:
    """Returns the data set in a folder or file (a bag), and the name of its reader.

    Raises TwinError if it does not exist, is empty, or has no known layout or no images of the left camera; if a file
    of it is damaged, or its times cannot be in seconds; or if a reader of another package cannot be loaded.
    """
    if problem := path_problem(folder):
        raise TwinError(ascii(str(folder))[1:-1][:200], problem, "the folder or the bag of a data set")
    if not folder.exists():
        raise TwinError(str(folder), "does not exist", "the folder or the bag of a data set")
    readers = all_readers(topics)
    try:
        if folder.is_dir() and not any(folder.iterdir()):
            raise TwinError(str(folder), "is empty", "the folder of a data set")
        reader = next((reader for reader in readers if reader.recognises(folder)), None)
        dataset = None if reader is None else reader.read(folder)
    except OSError as error:
        problem = f"cannot be read: {error.strerror or error}"
        raise TwinError(str(error.filename or folder), problem, "readable files and folders") from None
    if reader is None or dataset is None:
        layouts = "; ".join(f"{reader.name}: {reader.layout}" for reader in readers)
        raise TwinError(str(folder), "has no layout that a reader knows", layouts)
    if not dataset.images:
        raise TwinError(str(folder), "has no images of the left camera", reader.layout)
    check_times(dataset)
    return dataset, reader.name
