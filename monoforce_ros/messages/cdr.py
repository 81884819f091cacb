"""CDR writer: the wire format of ROS 2, for messages whose Python objects would be slow to build.

Large arrays are copied as blocks, so that a grid of 16 384 cells takes microseconds instead of tens of milliseconds.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence

import numpy as np

_HEADER = b"\x00\x01\x00\x00"  # little endian, no options


class CdrWriter:
    """Appends fields in the order of the message definition, aligned as CDR requires."""

    def __init__(self) -> None:
        self._buffer = bytearray(_HEADER)

    def align(self, size: int) -> None:
        """Pad to a multiple of ``size``, counted after the four bytes of the encapsulation header."""
        self._buffer += b"\x00" * (-(len(self._buffer) - len(_HEADER)) % size)

    @property
    def position(self) -> int:
        """Number of bytes written after the encapsulation header."""
        return len(self._buffer) - len(_HEADER)

    def fields(self, kinds: str, *values: float) -> None:
        """Scalars by their ``struct`` codes (``i I f d B`` …), each aligned to its own size."""
        for kind, value in zip(kinds, values, strict=True):
            self.align(struct.calcsize(kind))
            self._buffer += struct.pack("<" + kind, value)

    def string(self, text: str) -> None:
        """A string with its length and terminating zero."""
        data = text.encode() + b"\x00"
        self.fields("I", len(data))
        self._buffer += data

    def strings(self, texts: Sequence[str]) -> None:
        """A sequence of strings."""
        self.fields("I", len(texts))
        for text in texts:
            self.string(text)

    def header(self, stamp: int, frame_id: str) -> None:
        """``std_msgs/Header`` with a stamp in [ns]."""
        self.fields("iI", stamp // 10**9, stamp % 10**9)
        self.string(frame_id)

    def block(self, values: np.ndarray, alignment: int) -> None:
        """Elements in memory order, the first one aligned."""
        if values.size:
            self.align(alignment)
            self._buffer += np.ascontiguousarray(values).tobytes()

    def sequence(self, values: np.ndarray, alignment: int) -> None:
        """A sequence: its length along the first axis, then its elements."""
        self.fields("I", len(values))
        self.block(values, alignment)

    def bytes(self) -> bytes:
        """The finished message."""
        return bytes(self._buffer)
