"""Hands folders that a container engine made, as root, to the user that the services run as.

python -m services.folders UID:GID FOLDER=NAME ...

FOLDER is where the host's folder NAME is mounted. Changed is only what the engine has just made: an empty folder of
root, which is mounted from NAME itself and not from where a link of that name leads. What belongs to the user already
is left as it is. Exit 1, and why, for anything else.
"""

from __future__ import annotations

import os
import stat
import sys
from pathlib import Path, PurePosixPath

from protocol.errors import EitskinError, in_words

MODE = 0o700


class NotOurs(EitskinError):
    """A folder that is not to be touched. The text says what was found and what to do."""


def hand_over(folder: str, name: str, uid: int, gid: int, mounts: str) -> str:
    """What was done. Raises NotOurs, OSError."""
    fd = os.open(folder, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
    try:
        owner = os.fstat(fd).st_uid
        if owner == uid and (uid != 0 or stat.S_IMODE(os.fstat(fd).st_mode) == MODE or os.listdir(fd)):
            return f"{name} belongs to user {uid} already"
        if owner != 0:
            raise NotOurs(f"{name} belongs to user {owner}, expected {uid}: choose another folder")
        source = _source(folder, mounts)
        if not _same(source, name):
            raise NotOurs(f"{name} is a link to {source}: name a folder, or the target itself")
        if os.listdir(fd):
            raise NotOurs(f"{name} belongs to root and is not empty: choose another folder, or chown {uid} it yourself")
        os.fchown(fd, uid, gid)
        os.fchmod(fd, MODE)
    finally:
        os.close(fd)
    return f"{name} now belongs to user {uid}"


def _source(folder: str, mounts: str) -> str:
    """Which folder of its file system is mounted at `folder`; `mounts`: /proc/self/mountinfo, see proc(5)."""
    for line in reversed(mounts.splitlines()):
        fields = line.split(" ")
        if len(fields) > 4 and _plain(fields[4]) == folder:
            return _plain(fields[3])
    raise NotOurs(f"{folder} is no mounted folder")


def _plain(text: str) -> str:
    for code, character in (("\\040", " "), ("\\011", "\t"), ("\\012", "\n"), ("\\134", "\\")):
        text = text.replace(code, character)
    return text


def _same(source: str, name: str) -> bool:
    """Whether the path `source`, which begins at its file system's root, can be `name`, which begins at the host's (or
    is relative): then one ends with the other.
    """
    one, other = ([part for part in PurePosixPath(path).parts if part != "/"] for path in (source, name))
    shorter = min(len(one), len(other))
    return shorter > 0 and one[-shorter:] == other[-shorter:]


def main(arguments: list[str]) -> int:
    try:
        uid, gid = (int(number) for number in arguments[0].split(":"))
        pairs = [argument.split("=", 1) for argument in arguments[1:]]
        folders = [(folder, name) for folder, name in pairs]
    except (ValueError, IndexError):
        print(__doc__, file=sys.stderr)
        return 2
    mounts, failed = Path("/proc/self/mountinfo").read_text(encoding="utf-8", errors="surrogateescape"), 0
    for folder, name in folders:
        try:
            print(hand_over(folder, name, uid, gid, mounts))
        except (NotOurs, OSError) as why:
            print(f"folders: {in_words(why)}", file=sys.stderr)
            failed = 1
    return failed


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1:]))
