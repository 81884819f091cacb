"""Salvage: recover the messages of bags that were truncated before their index was written, or damaged later.

A recording cut off by a power loss has no index, so readers that start from the index reject it. Its messages are read
in sequence up to the damage. Sizes stated in the file are checked against its length before memory is allocated.
"""

from __future__ import annotations

import bz2
import io
import sqlite3
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from monoforce_ros.bags.types import type_store

_MCAP_MAGIC = b"\x89MCAP0\r\n"
_ZSTD_MAGIC = b"\x28\xb5\x2f\xfd"
_ROS1_MAGIC = b"#ROSBAG V2.0\n"
_LARGEST_RECORD = 1 << 30
"""Size of a chunk or message beyond which the file is considered damaged [bytes]."""
_SCHEMA, _CHANNEL, _MESSAGE, _CHUNK = 3, 4, 5, 6


class _BrokenError(Exception):
    """The file is truncated or damaged at this point."""


@dataclass(frozen=True)
class SalvagedTopic:
    """A topic and the number of its recovered messages."""

    topic: str
    msgtype: str
    msgcount: int


class SalvagedBag:
    """A bag file read from its start to the damage, with the interface of rosbags' reader that is used here.

    Args:
        files: the storage files of the bag, in order.

    Attributes:
        broken: reason why reading stopped, for each damaged file.
    """

    def __init__(self, files: list[Path]):
        self._files = files
        self.broken: list[str] = []
        self._types: Typestore | None = None
        self.is2 = not any(_starts_with(file, _ROS1_MAGIC) for file in files)
        kinds: dict[str, str] = {}
        counts: Counter[str] = Counter()
        self.start_time, self.end_time = 0, 0
        for topic, kind, received, _ in self._scan():
            kinds.setdefault(topic, kind)
            counts[topic] += 1
            self.start_time = min(self.start_time or received, received)
            self.end_time = max(self.end_time, received + 1)
        self.connections = [SalvagedTopic(topic, kind, counts[topic]) for topic, kind in kinds.items()]
        self.topics = {entry.topic: entry for entry in self.connections}
        self.message_count = sum(entry.msgcount for entry in self.connections)

    def messages(
        self, connections: Collection[SalvagedTopic], start: int | None = None, stop: int | None = None
    ) -> Iterator[tuple[SalvagedTopic, int, bytes]]:
        """Messages in the order of the file."""
        chosen = {entry.topic: entry for entry in connections}
        for topic, _, received, data in self._scan():
            if topic in chosen and (start is None or received >= start) and (stop is None or received < stop):
                yield chosen[topic], received, data

    def deserialize(self, data: bytes, message_type: str) -> Any:
        """A message with the attributes of its type."""
        if self.is2:
            return type_store().deserialize_cdr(data, message_type)
        return self._ros1_types().deserialize_ros1(data, message_type)

    def close(self) -> None:
        """Do nothing: no file stays open."""

    def _ros1_types(self) -> Typestore:
        if self._types is None:
            self._types = get_typestore(Stores.ROS1_NOETIC)
        return self._types

    def _scan(self) -> Iterator[tuple[str, str, int, bytes]]:
        """Topic, type, time of reception [ns] and content of each message."""
        self.broken = []
        for file in self._files:
            try:
                yield from self._scan_file(file)
            except (_BrokenError, OSError, struct.error, sqlite3.Error, ValueError, EOFError, RuntimeError) as error:
                self.broken.append(f"{file.name} breaks off: {error or type(error).__name__}")

    def _scan_file(self, file: Path) -> Iterator[tuple[str, str, int, bytes]]:
        if file.suffix == ".db3":
            yield from _scan_sqlite(file)
            return
        with file.open("rb") as stream:
            size = file.stat().st_size
            if _starts_with(file, _MCAP_MAGIC):
                stream.seek(len(_MCAP_MAGIC))
                yield from _scan_mcap(stream, size, {}, {})
            elif _starts_with(file, _ROS1_MAGIC):
                stream.seek(len(_ROS1_MAGIC))
                yield from self._scan_ros1(stream, size, {})
            else:
                raise _BrokenError("it is neither an mcap nor a ROS 1 bag file")

    def _scan_ros1(
        self, stream: BinaryIO, size: int, connections: dict[bytes, tuple[str, str]]
    ) -> Iterator[tuple[str, str, int, bytes]]:
        while stream.tell() < size:
            header = _ros1_header(_sized(stream, size, "<I"))
            data = _sized(stream, size, "<I")
            kind = header.get(b"op", b"\0")[0]
            if kind == 0x07:
                number = header[b"conn"]
                described = _ros1_header(data)
                name = described[b"type"].decode("utf-8", "replace")
                package, _, short = name.rpartition("/")
                message_type = f"{package.removesuffix('/msg')}/msg/{short}"
                self._learn(message_type, described.get(b"message_definition", b"").decode("utf-8", "replace"))
                connections[number] = header[b"topic"].decode("utf-8", "replace"), message_type
            elif kind == 0x05:
                content = _ros1_chunk(header.get(b"compression", b"none"), data)
                yield from self._scan_ros1(content, content.getbuffer().nbytes, connections)
            elif kind == 0x02 and header[b"conn"] in connections:
                seconds, nanoseconds = struct.unpack("<II", header[b"time"])
                topic, message_type = connections[header[b"conn"]]
                yield topic, message_type, seconds * 10**9 + nanoseconds, data

    def _learn(self, message_type: str, definition: str) -> None:
        types = self._ros1_types()
        if message_type in types.types or not definition:
            return
        try:
            types.register(
                {k: v for k, v in get_types_from_msg(definition, message_type).items() if k not in types.types}
            )
        except Exception:  # an invalid definition affects its topic only
            return


def storage_files(path: Path) -> list[Path]:
    """The storage files of a bag folder, or the file itself."""
    if path.is_file():
        return [path]
    found = [file for file in path.iterdir() if file.suffix in (".mcap", ".db3", ".bag", ".active")]
    # Hidden files are temporary, except in a hidden folder: an unfinished bag of a killed writer.
    return sorted(file for file in found if path.name.startswith(".") or not file.name.startswith("."))


def _starts_with(file: Path, magic: bytes) -> bool:
    with file.open("rb") as stream:
        return stream.read(len(magic)) == magic


def _take(stream: BinaryIO, count: int, left: int) -> bytes:
    if count > min(left, _LARGEST_RECORD):
        raise _BrokenError(f"a record of {count} bytes does not fit into the remaining {max(left, 0)} bytes")
    data = stream.read(count)
    if len(data) != count:
        raise _BrokenError("the file ends within a record")
    return data


def _sized(stream: BinaryIO, size: int, form: str) -> bytes:
    """Content of a length-prefixed field."""
    (count,) = struct.unpack(form, _take(stream, struct.calcsize(form), size - stream.tell()))
    return _take(stream, count, size - stream.tell())


def _scan_mcap(
    stream: BinaryIO, size: int, schemas: dict[int, str], channels: dict[int, tuple[str, int]]
) -> Iterator[tuple[str, str, int, bytes]]:
    def text(data: bytes, at: int) -> tuple[str, int]:
        (count,) = struct.unpack_from("<I", data, at)
        return data[at + 4 : at + 4 + count].decode("utf-8", "replace"), at + 4 + count

    while size - stream.tell() > len(_MCAP_MAGIC):
        kind, count = struct.unpack("<BQ", _take(stream, 9, size - stream.tell()))
        data = _take(stream, count, size - stream.tell())
        if kind == _SCHEMA:
            schemas[struct.unpack_from("<H", data)[0]] = text(data, 2)[0]
        elif kind == _CHANNEL:
            number, schema = struct.unpack_from("<HH", data)
            channels[number] = text(data, 4)[0], schema
        elif kind == _MESSAGE:
            number, _, received, _ = struct.unpack_from("<HIQQ", data)
            if number in channels:
                topic, schema = channels[number]
                yield topic, schemas.get(schema, ""), received, data[22:]
        elif kind == _CHUNK:
            (unpacked,) = struct.unpack_from("<Q", data, 16)
            compression, at = text(data, 28)
            if unpacked > _LARGEST_RECORD:
                raise _BrokenError(f"a chunk claims {unpacked} bytes")
            content = _unpack(compression, data[at + 8 :])
            yield from _scan_mcap(io.BytesIO(content), len(content), schemas, channels)


def unpacked_message(data: bytes) -> bytes:
    """A CDR-encoded message, decompressed if it is a zstd frame: only metadata.yaml tells that messages are.

    CDR begins with a zero. A frame that is damaged, or larger than any message, stays as it is.
    """
    if bytes(data[:4]) != _ZSTD_MAGIC:
        return data
    from backports import zstd

    frame = zstd.ZstdDecompressor()
    try:
        unpacked = frame.decompress(data, max_length=_LARGEST_RECORD)
    except zstd.ZstdError:
        return data
    return unpacked if frame.eof else data


def _unpack(compression: str, data: bytes) -> bytes:
    if not compression:
        return data
    try:
        if compression == "zstd":
            from backports import zstd

            return zstd.decompress(data)
        if compression == "lz4":
            from lz4 import frame  # type: ignore[import-untyped]

            return frame.decompress(data)
    except Exception as error:
        raise _BrokenError(f"a chunk cannot be decompressed: {error}") from error
    raise _BrokenError(f"a chunk is compressed by {compression!r}, expected zstd or lz4")


def _scan_sqlite(file: Path) -> Iterator[tuple[str, str, int, bytes]]:
    database = sqlite3.connect(f"file:{file}?mode=ro", uri=True)
    try:
        topics = {row[0]: (row[1], row[2]) for row in database.execute("SELECT id, name, type FROM topics")}
        for topic, received, data in database.execute("SELECT topic_id, timestamp, data FROM messages ORDER BY id"):
            if topic in topics:
                yield (*topics[topic], received, bytes(data))
    finally:
        database.close()


def _ros1_header(data: bytes) -> dict[bytes, bytes]:
    fields, at = {}, 0
    while at + 4 <= len(data):
        (count,) = struct.unpack_from("<I", data, at)
        name, equals, value = data[at + 4 : at + 4 + count].partition(b"=")
        if not equals or count > len(data) - at - 4:
            raise _BrokenError("a record has an invalid header")
        fields[name] = value
        at += 4 + count
    return fields


def _ros1_chunk(compression: bytes, data: bytes) -> io.BytesIO:
    if compression == b"none":
        return io.BytesIO(data)
    try:
        if compression == b"bz2":
            return io.BytesIO(bz2.decompress(data))
        if compression == b"lz4":
            from lz4 import frame

            return io.BytesIO(frame.decompress(data))
    except Exception as error:
        raise _BrokenError(f"a chunk cannot be decompressed: {error}") from error
    raise _BrokenError(f"a chunk is compressed by {compression!r}")
