"""Message types for reading and writing bags: those of ROS 2 Jazzy and of ``msg_defs/``."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path
from typing import Any

from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore
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


def learn(store: Typestore, message_type: str) -> bool:
    """Add a type, and those that it consists of, from the installed packages; whether that succeeded."""
    definitions: dict = {}
    waiting = [message_type]
    while waiting:
        name = waiting.pop()
        if name in store.types or name in definitions:
            continue
        file = _definition_of(name)
        if file is None:
            return False
        try:
            found = get_types_from_msg(file.read_text(encoding="utf-8"), name)
        except (OSError, ValueError, TypesysError):
            return False
        definitions.update(found)
        waiting += _used_types(found[name])
    store.register(definitions)
    return True


def _definition_of(message_type: str) -> Path | None:
    """File ``PREFIX/share/PACKAGE/msg/NAME.msg`` of a type in an installed package."""
    package, _, rest = message_type.partition("/")
    prefixes = os.environ.get("AMENT_PREFIX_PATH", "").split(os.pathsep)
    files = (Path(prefix) / "share" / package / f"{rest}.msg" for prefix in prefixes if prefix)
    return next((file for file in files if file.is_file()), None)


def _used_types(definition: Any) -> list[str]:
    """Types of the fields of a definition, without the basic ones."""
    found = []
    for _, (kind, argument) in definition[1]:
        while kind in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            kind, argument = argument[0]
        if kind == Nodetype.NAME:
            found.append(argument)
    return found
