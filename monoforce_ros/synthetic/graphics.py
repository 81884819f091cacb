"""MuJoCo, imported with a graphics library that this machine has.

MuJoCo decides at its import which library draws; every module here therefore takes ``mujoco`` from this one.
"""

from __future__ import annotations

import contextlib
import os
import sys
from ctypes.util import find_library

HOW_TO_DRAW = "install one with `sudo apt install libosmesa6`, or record without images: `--camera none`"

_LIBRARIES = {"osmesa": ("OSMesa",), "egl": ("EGL", "OpenGL")}


class DrawingError(RuntimeError):
    """Camera images were asked for, and no graphics library can draw them; the message says what to do."""


def _is_usable(backend: str) -> bool:
    return all(find_library(library) for library in _LIBRARIES.get(backend, ()))


def _choose_backend() -> None:
    chosen = os.environ.get("MUJOCO_GL", "")
    # Without its library, a backend that the environment asks for would make the import fail, drawing or not.
    if "mujoco" in sys.modules or (chosen and _is_usable(chosen)):
        return
    os.environ["MUJOCO_GL"] = next((name for name in _LIBRARIES if _is_usable(name)), "disable")


_choose_backend()
if os.environ.get("MUJOCO_GL") == "osmesa":
    # OSMesa and Triton (which torch imports when it pleases) each bring an LLVM; the process crashes unless Triton's
    # is loaded first.
    with contextlib.suppress(ImportError):
        import triton  # noqa: F401

import mujoco  # noqa: E402

__all__ = ["HOW_TO_DRAW", "DrawingError", "mujoco"]
