"""Message classes by their names."""

from __future__ import annotations

import importlib

from monoforce_ros.core import share_directory


def message_class(name: str) -> type | None:
    """The Python class of ``package/msg/Name``; None if its package is not installed."""
    package, _, message = name.partition("/msg/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), message, None)
    except ImportError:
        return None


def missing_package(name: str) -> str:
    """That the package of ``package/msg/Name`` is not installed, and how to get it."""
    package = name.partition("/")[0]
    remedy = f"sudo apt install ros-jazzy-{package.replace('_', '-')}"
    if (share_directory() / "msg_defs" / package / "package.xml").is_file():
        remedy += ", or `make interfaces` without an installed ROS"
    return f"the package {package} is not installed ({remedy})"
