"""BagWriter: write a rosbag2 folder that appears under its name only when it is complete."""

from __future__ import annotations

import itertools
import shutil
import sqlite3
from pathlib import Path
from types import TracebackType
from typing import Any

from rosbags.interfaces import Connection, Qos, QosDurability, QosHistory, QosLiveliness, QosReliability, QosTime
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.rosbag2.storage_mcap import McapWriter

from monoforce_ros.bags.types import learn, type_store
from monoforce_ros.core import unfinished_path

_STORAGES = {"mcap": StoragePlugin.MCAP, "sqlite3": StoragePlugin.SQLITE3}
_FOREVER = QosTime(sec=0x7FFFFFFF, nsec=0xFFFFFFFF)
_LATCHED = Qos(
    history=QosHistory.KEEP_LAST,
    depth=1,
    reliability=QosReliability.RELIABLE,
    durability=QosDurability.TRANSIENT_LOCAL,
    deadline=_FOREVER,
    lifespan=_FOREVER,
    liveliness=QosLiveliness.AUTOMATIC,
    liveliness_lease_duration=_FOREVER,
    avoid_ros_namespace_conventions=False,
)


def _unused(path: Path) -> Path:
    """The path, or one with a number where a writer that was killed has left its bag."""
    numbered = (path.with_name(f"{path.name}-{number}") for number in itertools.count(2))
    return path if not path.exists() else next(other for other in numbered if not other.exists())


class BagWriter:
    """Write a rosbag2 bag: ``with BagWriter(path) as bag: bag.write("/odom", message, stamp)``.

    The bag is written to a hidden folder next to its target and renamed when the block ends without an error, so the
    target is never half-written. After an error the unfinished bag is removed unless ``keep`` is set, which is meant
    for data that cannot be recorded again: the bag is then finished as it is, or left in the hidden folder if that
    fails.

    Args:
        path: folder of the bag; must not exist unless ``overwrite``.
        storage: ``mcap`` or ``sqlite3``.
        overwrite: replace an existing bag once the new one is complete.
        keep: keep the messages written before an error.

    Raises:
        ValueError: the storage is unknown.
        FileExistsError: the target exists and ``overwrite`` is off, or appears while the bag is written: it is then
            kept, and so is the new one in its hidden folder.
    """

    def __init__(self, path: str | Path, *, storage: str = "mcap", overwrite: bool = False, keep: bool = False):
        if storage not in _STORAGES:
            raise ValueError(f"storage: got {storage!r}, expected one of {sorted(_STORAGES)}")
        self.path = Path(path)
        if self.path.exists() and not overwrite:
            raise FileExistsError(f"{self.path} exists already: remove it, choose another name or allow overwriting")
        self._unfinished = _unused(unfinished_path(self.path))
        self._keep, self._overwrite = keep, overwrite
        self._writer = Writer(self._unfinished, version=9, storage_plugin=_STORAGES[storage])
        if storage == "mcap":
            # Compressed chunks within the file, like the mcap presets of ros2 bag.
            self._writer.set_compression(CompressionMode.STORAGE, CompressionFormat.ZSTD)
        self._types = type_store()
        self._connections: dict[str, Connection] = {}

    def __enter__(self) -> BagWriter:
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._writer.open()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is not None and not self._keep:
            if self._writer.storage:
                self._writer.storage.abort()
            shutil.rmtree(self._unfinished, ignore_errors=True)
            return
        try:
            self._finish()
        except FileExistsError:
            raise
        except (OSError, sqlite3.Error) as failure:
            if not self._keep:
                raise
            raise OSError(
                f"{failure}; the messages written so far lie in {self._unfinished} and can be read as they are"
            ) from failure

    def _finish(self) -> None:
        self._writer.close()
        if self.path.exists():
            if not self._overwrite:
                raise FileExistsError(
                    f"{self.path} was made by somebody else meanwhile and is kept; this bag is complete in "
                    f"{self._unfinished}: rename it"
                )
            shutil.rmtree(self.path)
        self._name_storage_file()
        self._unfinished.rename(self.path)

    def knows(self, message_type: str) -> bool:
        """Whether messages of a type can be written: it is one of Jazzy, of the package, or its definition is found."""
        return message_type in self._types.types or learn(self._types, message_type)

    def write(self, topic: str, message: Any, stamp: int) -> None:
        """Append a message (from :mod:`monoforce_ros.bags.builders`) received at ``stamp`` [ns]."""
        self.write_serialized(
            topic, message.__msgtype__, self._types.serialize_cdr(message, message.__msgtype__), stamp
        )

    def write_serialized(
        self, topic: str, message_type: str, data: bytes | memoryview, stamp: int, *, latched: bool = False
    ) -> None:
        """Append a CDR-encoded message received at ``stamp`` [ns].

        The first message of a topic decides by ``latched`` whether players offer late subscribers the last message
        (transient local), as they always do for ``tf_static``.
        """
        connection = self._connections.get(topic)
        if connection is None:
            latched = latched or topic.rsplit("/", 1)[-1] == "tf_static"
            connection = self._writer.add_connection(
                topic, message_type, typestore=self._types, offered_qos_profiles=[_LATCHED] if latched else []
            )
            self._connections[topic] = connection
        self._writer.write(connection, stamp, data)

    def flush(self) -> None:
        """Write all messages so far to disk, so that a killed process does not lose them."""
        storage = self._writer.storage
        if isinstance(storage, McapWriter):
            if storage.chunk.msgs:
                storage.close_chunk()
            storage.bio.flush()
        elif storage is not None:
            storage.conn.commit()

    @staticmethod
    def unfinished(path: str | Path) -> list[Path]:
        """Unfinished bags for ``path`` left by killed writers; :class:`BagReader` reads them as they are."""
        path = Path(path)
        return sorted(path.parent.glob(f".{path.name}.unfinished-*"))

    def _name_storage_file(self) -> None:
        """Name the storage file after the bag instead of the temporary folder."""
        metadata = self._unfinished / "metadata.yaml"
        text = metadata.read_text(encoding="utf-8")
        for file in self._unfinished.iterdir():
            if file.name.startswith(self._unfinished.name):
                name = file.name.replace(self._unfinished.name, self.path.name, 1)
                text = text.replace(file.name, name)
                file.rename(file.with_name(name))
        metadata.write_text(text, encoding="utf-8")
