"""Key files: a CURVE key pair of one's own, and folders with the public keys of those who may do something.

A file holds the lines `public-key = "..."` and, where it is the secret one, `secret-key = "..."`: 40 characters each
(the format of zmq.auth, so that keys made by any ZeroMQ program fit).
"""

from __future__ import annotations

import os
import re
import stat
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import zmq
from zmq.utils import z85

from .errors import EitskinError
from .whole_file import whole_file

MAX_FILE = 64 * 1024
_LINE = re.compile(rb'^\s*(public|secret)-key\s*=\s*"([^"]*)"', re.MULTILINE)


class TransportError(EitskinError, RuntimeError):
    """A socket cannot be opened as configured, or a key file cannot be used: the message says what was found and what
    to do.
    """


def write_keys(folder: Path, name: str) -> tuple[Path, Path]:
    """Make a CURVE key pair: the files (public, secret), the latter readable by us only. Raises OSError."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    public_key, secret_key = (key.decode() for key in zmq.curve_keypair())
    public, secret = folder / f"{name}.key", folder / f"{name}.key_secret"
    public_line, secret_line = f'    public-key = "{public_key}"\n', f'    secret-key = "{secret_key}"\n'
    note = "# Secret: it stays on this host, readable by its owner only."
    with whole_file(secret, 0o600) as one, whole_file(public, 0o644) as other:  # both or none: they are a pair
        one.write_text(f"{note}\ncurve\n{public_line}{secret_line}", encoding="ascii")
        other.write_text(f"# Public: for the other end.\ncurve\n{public_line}", encoding="ascii")
    return public, secret


def read_pair(path: Path) -> tuple[bytes, bytes]:
    """Our own (public, secret) key. Raises TransportError, also where others may read the file."""
    found, mode = _keys(path)
    if "secret" not in found:
        raise TransportError(f"key file {path} holds no secret key: name the .key_secret file")
    if mode & 0o077:
        raise TransportError(
            f"key file {path} has mode {mode:04o}, so others can use the key, expected 0600: chmod 600 {path}, and "
            "make a new key where others may have read it"
        )
    return found["public"], found["secret"]


def read_public(path: Path) -> bytes:
    """A public key. Raises TransportError."""
    return _keys(path)[0]["public"]


def _keys(path: Path) -> tuple[dict[str, bytes], int]:
    """The keys in a file, and its mode."""
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC), "rb") as file:
            about = os.fstat(file.fileno())
            if not stat.S_ISREG(about.st_mode):
                raise TransportError(f"key file {path}: found something that is no file")
            text = file.read(MAX_FILE)
    except OSError as bad:
        raise TransportError(f"key file {path}: {bad.strerror}; make one with `skin keys new`") from None
    found = {kind.decode(): key for kind, key in _LINE.findall(text)}
    if "public" not in found:
        raise TransportError(f'key file {path}: found no line public-key = "...", as `skin keys new` writes it')
    for kind, key in found.items():
        try:
            if len(z85.decode(key)) != 32:
                raise ValueError
        except (ValueError, KeyError, IndexError):
            raise TransportError(f"key file {path}: the {kind} key is damaged, expected 40 characters of Z85") from None
    return found, stat.S_IMODE(about.st_mode)


class KeyFolder:
    """The public keys in a folder's `*.key` files, read again when the folder changes. Any thread may ask.

    A file that holds no key is named in `problems`; the others stay good.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.problems: tuple[str, ...] = ()
        self._known: tuple[object, Mapping[bytes, str]] = (None, {})

    def keys(self) -> Mapping[bytes, str]:
        """Public key -> the name of its file."""
        try:
            files = sorted(path for path in self.path.iterdir() if path.suffix == ".key")
            seen: object = [(path, about.st_ino, about.st_size, about.st_mtime_ns) for path, about in _stats(files)]
        except OSError as bad:
            self.problems = (f"no key of {self.path} is good: {bad.strerror}",)
            self._known = (None, {})
            return {}
        if self._known[0] != seen:
            found: dict[bytes, str] = {}
            problems = []
            for file in files:
                try:
                    found[read_public(file)] = file.stem
                except TransportError as bad:
                    problems.append(f"{bad}; the other keys stay good")
            self.problems = tuple(problems)
            self._known = (seen, found)
        return self._known[1]


def _stats(files: list[Path]) -> list[tuple[Path, os.stat_result]]:
    found = []
    for path in files:
        try:
            found.append((path, path.stat()))
        except OSError:  # removed just now, or a dangling link
            found.append((path, path.lstat()) if path.is_symlink() else (path, os.stat_result([0] * 10)))
    return found


@dataclass(frozen=True)
class Admission:
    """The keys that a bound TCP socket lets in, and those of them that may change something."""

    own: bytes
    secret: bytes = field(repr=False)
    clients: KeyFolder
    operators: KeyFolder | None = None

    def keys(self) -> frozenset[bytes]:
        """All keys that may connect: our own, the clients' and the operators'."""
        return frozenset({self.own, *self.clients.keys(), *(self.operators.keys() if self.operators else ())})

    let_in: set[bytes] = field(default_factory=set, compare=False)
    """Keys that connected."""

    def allows(self, key: bytes) -> bool:
        """Whether this key may connect now, or stay."""
        return key in self.keys()

    def admit(self, key: bytes) -> bool:
        """The same at a handshake. The key is noted in `let_in` first, so that one that is removed just now is not
        forgotten.
        """
        self.let_in.add(key)
        if not self.allows(key):
            self.let_in.discard(key)
            return False
        return True

    def operates(self, key: bytes) -> bool:
        """Whether this key may change something."""
        return key == self.own or (self.operators is not None and key in self.operators.keys())

    @property
    def problems(self) -> list[str]:
        """Files that hold no key."""
        return [*self.clients.problems, *(self.operators.problems if self.operators else ())]
