"""MuJoCo, imported with a graphics library that is installed on this machine.

MuJoCo selects its graphics library on import, so every module here imports ``mujoco`` from this one.
"""

from __future__ import annotations

import contextlib
import os
import sys
from ctypes.util import find_library

HOW_TO_DRAW = "install one with `sudo apt install libosmesa6`, or record without images: `--camera none`"

_LIBRARIES = {"osmesa": ("OSMesa",), "egl": ("EGL", "OpenGL")}


class DrawingError(RuntimeError):
    """No graphics library can render the requested camera images; the message says what to install."""


def _is_usable(backend: str) -> bool:
    return all(find_library(library) for library in _LIBRARIES.get(backend, ()))


def _choose_backend() -> None:
    chosen = os.environ.get("MUJOCO_GL", "")
    # A backend requested by the environment without its library would make the import fail, rendering or not.
    if "mujoco" in sys.modules or (chosen and _is_usable(chosen)):
        return
    os.environ["MUJOCO_GL"] = next((name for name in _LIBRARIES if _is_usable(name)), "disable")


_choose_backend()
if os.environ.get("MUJOCO_GL") == "osmesa":
    # OSMesa and Triton (imported by torch at any time) each bring an LLVM; the process crashes unless Triton's is
    # loaded first.
    with contextlib.suppress(ImportError):
        import triton  # type: ignore[import-untyped]  # noqa: F401

import mujoco  # type: ignore[import-untyped]  # noqa: E402

__all__ = ["HOW_TO_DRAW", "DrawingError", "mujoco"]
