"""Access to the messages of a ROS 2 bag (MCAP or SQLite file, or folder with metadata.yaml) by the package rosbags.

A bag is untrusted. Messages are decoded with the message definitions of ROS 2 Humble, never with those in the bag, from
which rosbags would generate code. Sizes are checked before memory is allocated for them.
"""

import struct
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

from twin.core.optional_packages import optional
from twin.core.user_files import is_file
from twin.datasets.text_files import inside, read_yaml
from twin.errors import TwinError

_MOST_CHUNK_BYTES = 2**30  # largest chunk of an MCAP file after decompression
_MOST_MESSAGES = 20_000_000
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_SUFFIXES = (".mcap", ".db3")
_PURPOSE = "reading ROS 2 bags"


class BagMessage(NamedTuple):
    """Position of a message in a bag, and the time in its header."""

    topic: str
    logged_ns: int  #: time at which the message was recorded
    repetition: int  #: number of earlier messages of the topic with the same `logged_ns`
    stamp_ns: int  #: time in the header of the message; 0 if the publisher did not set it


def is_bag(path: Path) -> bool:
    return (path.suffix in _SUFFIXES and is_file(path)) or is_file(path / "metadata.yaml")


class Bag:
    """An open ROS 2 bag; every method raises TwinError if the bag is damaged.

    `topics` has the type of the messages of each topic, for example "sensor_msgs/msg/Image". Raises TwinError if the
    bag is damaged, too large, compressed by file or by message, or lacks a file, or rosbags is not installed.
    """

    def __init__(self, path: Path):
        self.path = path
        files = _files(path)
        rosbag2 = optional("rosbags.rosbag2", "exchange", _PURPOSE)
        _bound_decompression()
        for file in files:
            _check_end(file)
        with self._damage():
            self._reader: Any = rosbag2.Reader(path)
            self._reader.open()
            self.topics: dict[str, str] = {one.topic: one.msgtype for one in self._reader.connections}
            self._check_sizes()

    def first(self, topic: str) -> Any:
        return next((message for _, message in self.messages(topic)), None)

    def messages(self, topic: str) -> Iterator[tuple[int, Any]]:
        """Yields the time of recording [ns] and the decoded message, for all messages of a topic in their order."""
        with self._damage():
            for _, logged_ns, data in self._reader.messages(self._connections([topic])):
                yield logged_ns, _typestore().deserialize_cdr(data, self.topics[topic])

    def index(self, topics: Sequence[str]) -> dict[str, list[BagMessage]]:
        """Returns the positions of the messages of each topic, which begin with a header, in order of recording."""
        found: dict[str, list[BagMessage]] = {topic: [] for topic in topics}
        with self._damage():
            for connection, logged_ns, data in self._reader.messages(self._connections(topics)):
                before = found[connection.topic]
                same = before[-1].repetition + 1 if before and before[-1].logged_ns == logged_ns else 0
                before.append(BagMessage(connection.topic, logged_ns, same, _stamp_ns(data)))
        return found

    def message(self, position: BagMessage) -> Any:
        """Returns the message at a position, decoded; raises ValueError if it is damaged or missing."""
        try:
            connections = self._connections([position.topic])
            start = position.logged_ns
            for k, (_, _, data) in enumerate(self._reader.messages(connections, start, start + 1)):
                if k == position.repetition:
                    return _typestore().deserialize_cdr(data, self.topics[position.topic])
        except Exception as error:  # a parser of damaged data may raise any error
            raise ValueError(repr(error)) from None
        raise ValueError("missing")

    def _connections(self, topics: Sequence[str]) -> list[Any]:
        return [one for one in self._reader.connections if one.topic in topics]

    def _check_sizes(self) -> None:
        if self._reader.message_count > _MOST_MESSAGES:
            raise ValueError(f"{self._reader.message_count} messages; at most {_MOST_MESSAGES}")
        for storage in getattr(self._reader.storage, "storages", [self._reader.storage]):
            chunks = getattr(storage, "chunks", None)
            if chunks is not None and not chunks and self._reader.message_count:
                raise ValueError("no index of chunks; `mcap recover FILE -o NEW` writes one")
            _check_chunk(max((chunk.uncompressed_size for chunk in chunks or ()), default=0))

    @contextmanager
    def _damage(self) -> Iterator[None]:
        try:
            yield
        except (TwinError, GeneratorExit):
            raise
        except Exception as error:  # a parser of damaged data may raise any error
            text = " ".join(str(error).split())[:200] or type(error).__name__
            raise TwinError(str(self.path), f"cannot be read: {text}", "an undamaged ROS 2 bag") from None


def _files(path: Path) -> list[Path]:
    """Returns the files of a bag: the path itself, or those in metadata.yaml; a link out of the folder is refused."""
    if not path.is_dir():
        return [path]
    source = path / "metadata.yaml"
    table = read_yaml(source).get("rosbag2_bagfile_information")
    names = table.get("relative_file_paths") if isinstance(table, dict) else None
    if not isinstance(table, dict) or not isinstance(names, list) or not names:
        raise TwinError(str(source), "does not describe a ROS 2 bag", "metadata.yaml with relative_file_paths")
    if table.get("compression_mode"):
        problem = f"the bag is compressed (mode {str(table['compression_mode'])[:20]!r})"
        raise TwinError(str(source), problem, "a bag without compression of files or messages")
    files = [inside(path, Path(str(name)).name, source) for name in names]
    if missing := [file.name for file in files if not is_file(file)]:
        raise TwinError(str(source), f"{missing[0][:100]} is missing", "all files of the bag")
    return files


def _check_end(file: Path) -> None:
    if file.suffix != ".mcap":
        return
    with file.open("rb") as opened:
        start = opened.read(len(_MCAP_MAGIC))
        if start != _MCAP_MAGIC:
            raise TwinError(str(file), "is not an MCAP file" if start else "is empty", "a ROS 2 bag")
        opened.seek(-min(file.stat().st_size, len(_MCAP_MAGIC)), 2)
        if file.stat().st_size < 2 * len(_MCAP_MAGIC) or opened.read() != _MCAP_MAGIC:
            raise TwinError(str(file), "is truncated", "a complete bag; `mcap recover FILE -o NEW` saves its beginning")


def _check_chunk(size: int) -> None:
    if size > _MOST_CHUNK_BYTES:
        raise ValueError(f"a chunk is larger than {_MOST_CHUNK_BYTES / 2**20:g} MiB")


def _stamp_ns(data: bytes | memoryview) -> int:
    """Returns the time [ns] in the header with which a message in CDR begins (OMG DDS-XTypes 1.3, section 7.4)."""
    if len(data) < 12:
        raise ValueError("a message without header")
    seconds, nanoseconds = struct.unpack_from("<iI" if data[1] & 1 else ">iI", data, 4)
    return seconds * 1_000_000_000 + nanoseconds


@cache
def _typestore() -> Any:
    typesys = optional("rosbags.typesys", "exchange", _PURPOSE)
    return typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)


@cache
def _bound_decompression() -> None:
    """Makes rosbags stop decompressing a chunk beyond the size that it states, which it compares only afterwards."""
    storage = optional("rosbags.rosbag2.storage_mcap", "exchange", _PURPOSE)
    lz4 = optional("lz4.frame", "exchange", _PURPOSE)

    def from_zstd(data: bytes, size: int) -> bytes:
        _check_chunk(size)
        return storage.zstd.ZstdDecompressor().decompress(data, max_length=size + 1)

    def from_lz4(data: bytes, size: int) -> bytes:
        _check_chunk(size)
        return lz4.LZ4FrameDecompressor().decompress(data, max_length=size + 1)

    storage.DECOMPRESSORS.update({"zstd": from_zstd, "lz4": from_lz4})
