"""Message types for reading and writing bags: those of ROS 2 Jazzy and of ``msg_defs/``."""

from __future__ import annotations

from functools import cache
from pathlib import Path

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from monoforce_ros.core import share_directory


@cache
def type_store() -> Typestore:
    """Jazzy's types and every ``msg_defs/PACKAGE/msg/NAME.msg``."""
    store = get_typestore(Stores.ROS2_JAZZY)
    folder = share_directory() / "msg_defs"
    definitions: dict = {}
    for file in sorted(folder.glob("*/msg/*.msg")):
        name = f"{file.parent.parent.name}/msg/{file.stem}"
        if name not in store.types:
            definitions.update(get_types_from_msg(Path(file).read_text(encoding="utf-8"), name))
    if definitions:
        store.register(definitions)
    return store
