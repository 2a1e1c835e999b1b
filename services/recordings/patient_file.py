"""A file that waits where nothing can be written: a full disk, a quota, a limit, a read-only or broken medium. What
cannot be written stays in memory, up to a limit, and is written when it can be again; so its writers need not know.
"""

from __future__ import annotations

import contextlib
import errno
import os
import time
from pathlib import Path

KEPT_BYTES = 4 * 1024 * 1024
"""Kept in memory while nothing can be written; beyond, the caller is to drop messages (`room` says so)."""
RETRY_S = 0.5
_NO_SYNC = (errno.EINVAL, errno.ENOSYS, errno.ENOTSUP)  # file systems that cannot


class PatientFile:
    """Append only. Raises OSError only where it cannot be opened."""

    def __init__(self, path: Path, overwrite: bool = False) -> None:
        """overwrite: it has another name until `replace`."""
        if path.exists() and not (path.is_file() or path.is_dir()):  # its mode is not ours to change: /dev/null is one
            raise OSError(errno.EINVAL, "it is a device, a pipe or a socket, expected a file")
        if overwrite and path.is_dir():
            raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR))
        self._path = Path(os.path.realpath(path)) if overwrite else path
        self._now = self._path.with_name(f".{self._path.name}.{os.getpid()}") if overwrite else path
        self._fd = os.open(self._now, os.O_WRONLY | os.O_CREAT | os.O_CLOEXEC | os.O_EXCL, 0o600)
        os.fchmod(self._fd, 0o600)  # whatever the umask: who pressed where is nobody else's business
        self.written = 0
        """Bytes that the system has taken."""
        self._waiting = bytearray()
        self._retry_at = 0.0
        self.full = ""
        """Why nothing can be written now, as the system says it; "" while all is well."""
        self.closed = False

    def replace(self) -> None:
        """Take the place of the file that is to be overwritten; where that cannot be, `full` says why."""
        if self._now != self._path:
            try:
                os.replace(self._now, self._path)
                self._now = self._path
            except OSError as bad:
                self.full = os.strerror(bad.errno or 0)

    def remove(self) -> None:
        """Delete it: nothing is in it."""
        with contextlib.suppress(OSError):
            self._now.unlink()

    def tell(self) -> int:
        return self.written + len(self._waiting)

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
        try:
            ours = os.fstat(self._fd)
            there = os.stat(self._now)
        except (FileNotFoundError, NotADirectoryError):
            return "deleted" if ours.st_nlink == 0 else "moved"
        except OSError:  # the medium does not answer: `full` says so
            return ""
        same = (there.st_dev, there.st_ino) == (ours.st_dev, ours.st_ino)
        return "" if same else "deleted" if ours.st_nlink == 0 else "moved"

    def flush(self, now: bool = False) -> None:
        """Hand what waits to the operating system, as far as it takes it. While it does not it is asked every RETRY_S,
        or `now`.
        """
        if self.full and not now and time.monotonic() < self._retry_at:
            return
        while self._waiting:
            try:
                count = os.write(self._fd, bytes(self._waiting[: 1 << 20]))
            except OSError as bad:
                self.full, self._retry_at = os.strerror(bad.errno or 0), time.monotonic() + RETRY_S
                return
            self.written += count
            del self._waiting[:count]
        self.full = ""

    def ends_with(self, end: int, ending: bytes) -> bool:
        """Whether `ending` could be written behind the first `end` bytes, instead of all that came after those. Raises
        OSError where these cannot be taken away.
        """
        os.ftruncate(self._fd, end)
        os.lseek(self._fd, end, os.SEEK_SET)
        self._waiting.clear()
        self.written = end
        self._waiting += ending
        self.flush(now=True)
        return not self._waiting

    def close(self) -> None:
        """Write what can be, down to the medium, and close; `full` then says whether that failed."""
        if self.closed:
            return
        self.closed = True
        self.flush(now=True)
        self._waiting.clear()
        try:
            os.fsync(self._fd)
        except OSError as bad:  # what the system took before may not be on the medium
            if bad.errno not in _NO_SYNC:
                self.full = os.strerror(bad.errno or 0)
        try:
            os.close(self._fd)
        except OSError as bad:
            self.full = os.strerror(bad.errno or 0)
