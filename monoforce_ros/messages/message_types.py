"""Message classes by their names."""

from __future__ import annotations

import importlib


def message_class(name: str) -> type | None:
    """The Python class of ``package/msg/Name``; None if its package is not installed."""
    package, _, message = name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), message, None)
    except ImportError:
        return None
