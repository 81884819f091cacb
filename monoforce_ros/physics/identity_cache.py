"""IdentityCache: what was derived from objects, found again by the objects themselves."""

from __future__ import annotations

import threading
from collections import OrderedDict
from collections.abc import Callable, Hashable, Sequence

import torch
from torch import Tensor


class IdentityCache[Value]:
    """Values derived from tensors and other objects, kept as long as these are among the last ones used.

    A robot's tensors are the same from one rollout to the next; what follows from them alone takes longer to build than
    a single trajectory takes to integrate. Objects are compared by identity, and kept, so that none can take another
    one's place; a tensor that was changed in place counts as another one. Thread-safe.

    Args:
        size: number of values that are kept.
    """

    def __init__(self, size: int = 16):
        self._size = size
        self._entries: OrderedDict[Hashable, tuple[tuple[object, ...], Value]] = OrderedDict()
        self._lock = threading.Lock()

    def get(self, objects: Sequence[object], make: Callable[[], Value], *, values: Hashable = None) -> Value:
        """The value that belongs to some objects, and to ``values``, which are compared as such.

        It is made if it is not known, or if one of the objects requires a gradient.
        """
        if any(isinstance(entry, Tensor) and (entry.requires_grad or entry.is_inference()) for entry in objects):
            return make()
        key = values, *((id(entry), entry._version if isinstance(entry, Tensor) else 0) for entry in objects)
        with self._lock:
            if key in self._entries:
                self._entries.move_to_end(key)
                return self._entries[key][1]
        # Under inference mode tensors are made that must not be used outside of it.
        with torch.inference_mode(False):
            value = make()
        with self._lock:
            self._entries[key] = tuple(objects), value
            while len(self._entries) > self._size:
                self._entries.popitem(last=False)
        return value
