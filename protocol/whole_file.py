"""A file that takes its place whole, or not at all: a full disk or a broken one leaves what was there as it was."""

from __future__ import annotations

import contextlib
import os
import stat
from collections.abc import Iterator
from pathlib import Path


@contextlib.contextmanager
def whole_file(path: Path, mode: int | None = None) -> Iterator[Path]:
    """Where to write what is to become `path`: there is no such file yet. When the block ends it is brought to the
    medium and takes the place of what was there; when anything fails, that stays. A device or a pipe is written to as
    it is.

    mode: of the file, which then takes the place of a link too; None: as it is written, and no wider than that of the
    file that is there. Raises OSError, which names `path`.
    """
    place = Path(os.path.realpath(path)) if mode is None else path.absolute()
    part = place.with_name(f".{os.getpid()}.{place.name[-60:]}")
    try:
        there = place.stat() if place.exists() else None
        if there is not None and not stat.S_ISREG(there.st_mode):
            yield path
            return
        part.unlink(missing_ok=True)
        if mode is not None:
            os.close(os.open(part, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode))
        yield part
        if there is not None and mode is None:
            os.chmod(part, stat.S_IMODE(there.st_mode & part.stat().st_mode))
        _sync(part)
        os.replace(part, place)
    except OSError as why:
        if why.filename not in (None, str(part), str(place)):
            raise
        raise OSError(why.errno, why.strerror or str(why), str(path)) from None
    finally:
        with contextlib.suppress(OSError):
            part.unlink(missing_ok=True)


def write_whole(path: Path, content: str | bytes, mode: int | None = None) -> None:
    """The content of a file, text in UTF-8. Raises OSError."""
    with whole_file(path, mode) as part:
        part.write_bytes(content.encode() if isinstance(content, str) else content)


def _sync(path: Path) -> None:
    """Bring it to the medium: some say only then that they have no room. Raises OSError."""
    fd = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)
