"""What is made of a bundle once in a process and shared by all who have that bundle, by its hash.

Each tare that calibrates makes a bundle with a hash of its own, so what is kept is bounded: whatever somebody still
holds is shared, and beside that the few that were made last are kept for who comes next.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Generic, TypeVar
from weakref import WeakValueDictionary

from models.bundle import Bundle
from models.measurement.responses.tables import SkinTables, tables_of

T = TypeVar("T")

TABLES = 2  # kept that no skin holds, 14 MB each


class ByBundle(Generic[T]):
    """A function of a bundle that remembers. Threads may share it; two that ask at once may both make one."""

    def __init__(self, make: Callable[[Bundle], T], most: int) -> None:
        """most: so many are kept that nobody holds."""
        self._make = make
        self._held: WeakValueDictionary[str, T] = WeakValueDictionary()
        self._newest: deque[T] = deque(maxlen=most)

    def __call__(self, bundle: Bundle) -> T:
        found = self._held.get(bundle.hash)
        if found is None:
            found = self._held[bundle.hash] = self._make(bundle)
            self._newest.append(found)
        return found


skin_tables: ByBundle[SkinTables] = ByBundle(tables_of, TABLES)
