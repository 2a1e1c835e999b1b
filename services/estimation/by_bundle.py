"""What is made of a bundle once in a process and shared by all who have that bundle, by its hash.

Each tare that calibrates makes a bundle with a hash of its own, so what is kept is bounded: whatever somebody still
holds is shared, and beside that the few that were used last are kept for who comes next.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable
from threading import Lock
from typing import Generic, TypeVar
from weakref import WeakValueDictionary

from models.bundle import Bundle

T = TypeVar("T")


class ByBundle(Generic[T]):
    """A function of a bundle that remembers. Threads may share it; two that ask at once may both make one."""

    def __init__(self, make: Callable[[Bundle], T], most: int) -> None:
        """most: so many are kept that nobody holds."""
        self._make, self._most = make, most
        self._held: WeakValueDictionary[str, T] = WeakValueDictionary()
        self._recent: OrderedDict[str, T] = OrderedDict()
        self._lock = Lock()

    def __call__(self, bundle: Bundle) -> T:
        with self._lock:
            found = self._held.get(bundle.hash)
        if found is None:
            found = self._make(bundle)
        with self._lock:
            self._held[bundle.hash] = self._recent[bundle.hash] = found
            self._recent.move_to_end(bundle.hash)
            while len(self._recent) > self._most:
                self._recent.popitem(last=False)
        return found

    def __len__(self) -> int:
        """How many are in memory."""
        return len(self._held)
