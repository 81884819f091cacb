"""BagReader: read the messages of a ROS 2 or ROS 1 bag one at a time."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection, QosDurability

from monoforce_ros.bags.salvage import SalvagedBag, storage_files, unpacked_message
from monoforce_ros.bags.types import type_store


class BagError(ValueError):
    """A bag that cannot be read; the message names the file, the problem and the remedy."""


@dataclass(frozen=True)
class BagMessage:
    """A message of a bag, decoded on demand."""

    topic: str
    message_type: str
    received: int
    """Time of reception [ns]."""
    data: bytes
    _reader: BagReader

    def decode(self) -> Any:
        """The message with the attributes of its ROS type; raises ``BagError`` if its bytes do not fit the type."""
        try:
            return self._reader._any.deserialize(self.data, self.message_type)
        except Exception as error:
            raise BagError(
                f"{self._reader.path}: a {self.message_type} on {self.topic} cannot be decoded: {error}"
            ) from error

    def cdr(self) -> bytes:
        """The message encoded as CDR (ROS 2), also if the bag is of ROS 1."""
        if self._reader.is_ros2:
            return bytes(self.data)
        # With the definitions of ROS 2, so that the converter drops the sequence number of headers.
        try:
            return bytes(type_store().ros1_to_cdr(self.data, self.message_type))
        except Exception as error:
            raise BagError(
                f"{self._reader.path}: a {self.message_type} on {self.topic} cannot be converted to ROS 2: {error}"
            ) from error


class BagReader:
    """Read a bag in constant memory: ``with BagReader(path) as bag: for message in bag.messages(): ...``.

    Args:
        path: a rosbag2 folder, a single ``.mcap`` or ``.db3`` file, or a ROS 1 ``.bag`` file.

    Raises:
        BagError: on opening, if the bag is missing, of an unknown kind, or so damaged that no message can be read.
            A truncated bag is read up to the damage and reported in ``warnings``.
    """

    def __init__(self, path: str | Path):
        self.path = Path(path)
        self._any: AnyReader | SalvagedBag
        self.warnings: tuple[str, ...] = ()
        """Defects of a bag that can be read only in part."""

    @property
    def is_ros2(self) -> bool:
        """Whether messages are CDR-encoded (ROS 2)."""
        return self._any.is2

    def __enter__(self) -> BagReader:
        path = self.path
        if not path.exists():
            raise BagError(f"{path} does not exist; expected a rosbag2 folder or a ROS 1 .bag file")
        if path.is_file() and path.suffix in (".mcap", ".db3") and (path.parent / "metadata.yaml").is_file():
            path = path.parent
        try:
            if path.is_dir() and not (path / "metadata.yaml").is_file():
                raise ValueError("there is no metadata.yaml")
            self._any = AnyReader([path], default_typestore=type_store())
            self._any.open()
        except Exception as error:  # rosbags raises errors of its parsers as they are
            self._salvage(error)
        return self

    def _salvage(self, reason: Exception) -> None:
        """Read a bag without an index as far as possible; raise ``BagError`` if no message can be read."""
        if self.path.suffix in (".zst", ".zstd"):
            raise BagError(
                f"{self.path} is a compressed file of a bag: give the folder that holds it and its metadata.yaml, or "
                f"decompress it (zstd -d {self.path.name})"
            ) from reason
        files = storage_files(self.path)
        salvaged = SalvagedBag(files) if files else None
        if salvaged is None or not salvaged.message_count:
            where = "; ".join(salvaged.broken) if salvaged else "it contains no .mcap, .db3 or .bag file"
            raise BagError(
                f"{self.path} cannot be read ({type(reason).__name__}: {reason}; {where}): expected a rosbag2 folder "
                "or a ROS 1 .bag file; is it still being written?"
            ) from reason
        self._any = salvaged
        self.warnings = (
            f"{self.path} has no usable index ({reason}): it was cut off or damaged. "
            f"{salvaged.message_count} messages were recovered by reading it from the start",
            *salvaged.broken,
        )

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the bag's files."""
        self._any.close()

    @property
    def topics(self) -> dict[str, str]:
        """Message type of every topic."""
        return {connection.topic: connection.msgtype for connection in self._any.connections}

    @property
    def latched(self) -> set[str]:
        """Topics whose publishers offered late subscribers their last message: transient local, latched in ROS 1."""
        return {connection.topic for connection in self._any.connections if _is_latched(connection)}

    @property
    def counts(self) -> dict[str, int]:
        """Number of messages on every topic."""
        return {name: info.msgcount for name, info in self._any.topics.items()}

    @property
    def start(self) -> int:
        """Time of reception of the first message [ns]."""
        return self._any.start_time

    @property
    def end(self) -> int:
        """Time just after the reception of the last message [ns]."""
        return self._any.end_time

    @property
    def duration(self) -> float:
        """Length of the bag [s]."""
        return max(0, self.end - self.start) * 1e-9 if self.message_count else 0.0

    @property
    def message_count(self) -> int:
        """Number of messages."""
        return self._any.message_count

    def of_type(self, *message_types: str) -> list[str]:
        """Topics that carry one of the message types, in order of name."""
        return sorted(topic for topic, message_type in self.topics.items() if message_type in message_types)

    def messages(
        self, topics: Collection[str] | None = None, *, start: int | None = None, stop: int | None = None
    ) -> Iterator[BagMessage]:
        """Messages in order of reception, of all topics or the named ones, from ``start`` to before ``stop`` [ns].

        Raises ``BagError`` where the file is truncated or damaged, after the messages before that point.
        """
        connections: list[Connection] = [
            connection for connection in self._any.connections if topics is None or connection.topic in topics
        ]
        if not connections:
            return
        try:
            for connection, received, data in self._any.messages(connections, start=start, stop=stop):
                content = unpacked_message(data) if self.is_ros2 else data
                yield BagMessage(connection.topic, connection.msgtype, received, content, self)
        except GeneratorExit:
            raise
        except BagError:
            raise
        except Exception as error:
            raise BagError(
                f"{self.path} breaks off while being read ({type(error).__name__}: {error}): it is truncated or damaged"
            ) from error


def _is_latched(connection: Connection) -> bool:
    if connection.topic.rpartition("/")[2] == "tf_static":
        return True
    # A salvaged bag does not say.
    offers = getattr(connection, "ext", None)
    offered = getattr(offers, "offered_qos_profiles", None)
    if offered is None:
        return bool(getattr(offers, "latching", None))
    return bool(offered) and all(profile.durability == QosDurability.TRANSIENT_LOCAL for profile in offered)
