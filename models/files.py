"""Files that somebody else may have made: opened only where they are files, read only up to a bound.

A folder, a pipe or a device under a file's name is refused rather than waited for.
"""

from __future__ import annotations

import os
import stat
from typing import BinaryIO

from protocol.errors import EitskinError

MAX_TEXT = 4 * 1024 * 1024
"""Bytes of a file of text: TOML, JSON, CSV."""


class FileError(EitskinError):
    """The file cannot be used: names it, says what was found and what was expected."""


def open_file(path: str | os.PathLike[str], most: int, follow: bool = True) -> BinaryIO:
    """A regular file of at most `most` bytes, opened for reading. Raises FileError.

    follow: whether `path` may be a symbolic link.
    """
    flags = os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC | (0 if follow else os.O_NOFOLLOW)
    try:
        fd = os.open(path, flags)  # NONBLOCK: a pipe that nobody writes to is opened at once, and refused below
    except (OSError, ValueError) as why:  # ValueError: a zero byte in the name
        raise FileError(f"{path}: cannot be read: {getattr(why, 'strerror', None) or why}") from None
    try:
        check(os.fstat(fd), path, most)
        return os.fdopen(fd, "rb")
    except BaseException:
        os.close(fd)
        raise


def check(found: os.stat_result, path: str | os.PathLike[str], most: int) -> None:
    """Raises FileError where this is no regular file, or a larger one."""
    if not stat.S_ISREG(found.st_mode):
        raise FileError(f"{path}: cannot be read: found {_kind(found.st_mode)}, expected a file")
    if found.st_size > most:
        raise FileError(f"{path}: cannot be read: found {found.st_size} bytes, expected at most {most}")


def _kind(mode: int) -> str:
    kinds = {stat.S_IFDIR: "a folder", stat.S_IFIFO: "a pipe", stat.S_IFSOCK: "a socket"}
    return kinds.get(stat.S_IFMT(mode), "a device")


def read_bytes(path: str | os.PathLike[str], most: int) -> bytes:
    """The bytes of a regular file, at most `most`. Raises FileError."""
    with open_file(path, most) as file:
        try:
            content = file.read(most + 1)
        except OSError as why:
            raise FileError(f"{path}: cannot be read: {why.strerror}") from None
    if len(content) > most:  # it grew meanwhile
        raise FileError(f"{path}: cannot be read: found more than {most} bytes, expected at most {most}")
    return content


def read_text(path: str | os.PathLike[str], most: int = MAX_TEXT) -> str:
    """The UTF-8 text of a file; a byte order mark is left out. Raises FileError."""
    try:
        return read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as why:
        raise FileError(f"{path}: cannot be read: is not UTF-8 text ({why.reason} at byte {why.start})") from None
