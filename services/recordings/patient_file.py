"""A file that waits for a full disk: what does not fit stays in memory, up to a limit, and is written when there is
room again. Nothing that was accepted is lost or written in part, so its writers need not know of it.
"""

from __future__ import annotations

import errno
import os
import time
from pathlib import Path

FULL = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)
KEPT_BYTES = 4 * 1024 * 1024
"""Kept in memory while the disk is full; beyond, the caller is to drop messages (`room` says so)."""
RETRY_S = 0.5


class PatientFile:
    """Append only. Raises OSError for anything but a full disk."""

    def __init__(self, path: Path, overwrite: bool = False) -> None:
        kind = os.O_TRUNC if overwrite else os.O_EXCL
        if path.exists() and not (path.is_file() or path.is_dir()):  # its mode is not ours to change: /dev/null is one
            raise OSError(errno.EINVAL, "it is a device, a pipe or a socket, expected a file")
        self._path = path
        self._fd = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | kind, 0o600)
        os.fchmod(self._fd, 0o600)  # one that is overwritten too: who pressed where is nobody else's business
        self._written = 0
        self._waiting = bytearray()
        self._retry_at = 0.0
        self.full = ""
        """Why nothing can be written now, as the system says it; "" while all is well."""
        self.closed = False

    def tell(self) -> int:
        return self._written + len(self._waiting)

    def write(self, data: bytes | bytearray | memoryview) -> int:
        self._waiting += data
        return len(data)

    @property
    def room(self) -> bool:
        """Whether more may be written."""
        return not self.full or len(self._waiting) < KEPT_BYTES

    @property
    def elsewhere(self) -> str:
        """ "" while the file is where it was made, else "deleted" or "moved"."""
        ours = os.fstat(self._fd)
        try:
            there = os.stat(self._path)
        except OSError:  # no such file, no such folder
            return "deleted" if ours.st_nlink == 0 else "moved"
        same = (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)
        return "" if same else "deleted" if ours.st_nlink == 0 else "moved"

    def flush(self, now: bool = False) -> None:
        """Hand what waits to the operating system, as far as there is room. While the disk is full it is tried every
        RETRY_S, or `now`.
        """
        if self.full and not now and time.monotonic() < self._retry_at:
            return
        while self._waiting:
            try:
                count = os.write(self._fd, bytes(self._waiting[: 1 << 20]))
            except OSError as bad:
                if bad.errno not in FULL:
                    raise
                self.full, self._retry_at = os.strerror(bad.errno or 0), time.monotonic() + RETRY_S
                return
            self._written += count
            del self._waiting[:count]
        self.full = ""

    def close(self) -> None:
        """Write what there is room for, and close."""
        if not self.closed:
            self.closed = True
            try:
                self.flush(now=True)
            finally:
                os.close(self._fd)
