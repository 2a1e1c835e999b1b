"""The board's serial line as the host sees it: a pty under a name in the runtime folder, or a TCP port.

A pty has no baud rate, so `Line` paces what is sent with a token bucket. Both ends of an unplug are played: the name
goes, readers get an I/O error, and the device comes back as another pty.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import socket
import struct
import termios
import time
import tty
from collections import deque
from pathlib import Path
from typing import Protocol
from urllib.parse import urlsplit

from protocol.part_size import BAUD

BURST_S = 0.002  # the bucket's depth: what a USB adapter hands over at once
BACKLOG_S = 0.25  # of bytes; a board that has more to send drops whole messages
UNREAD = 3500  # bytes in a pty that nobody may be reading (the kernel's line buffer holds 4095)
UNREAD_S = 0.3


class Line:
    """Token bucket: bytes go in at once and come out at the line's rate, 10 bits each."""

    def __init__(self, baud: int = BAUD) -> None:
        self.rate = baud / 10
        self.backlog = 0
        self.dropped = 0
        self._queue: deque[bytes] = deque()
        self._tokens, self._then = 0.0, 0.0

    def push(self, message: bytes, now: float) -> bool:
        """Queue a message; False and it is dropped where the backlog is too long."""
        if self.backlog + len(message) > self.rate * BACKLOG_S and self.backlog:
            self.dropped += 1
            return False
        if not self.backlog:  # the line was idle: nothing was saved up
            self._tokens, self._then = 0.0, now
        self._queue.append(message)
        self.backlog += len(message)
        return True

    def pull(self, now: float) -> bytes:
        """What has gone over the line by now."""
        # After a late wake-up the line has gone on sending, so tokens are not capped while bytes wait.
        self._tokens += max(0.0, now - self._then) * self.rate
        self._then = now
        out = []
        while self._queue and self._tokens >= 1:
            head = self._queue.popleft()
            n = min(len(head), int(self._tokens))
            out.append(head[:n])
            if n < len(head):
                self._queue.appendleft(head[n:])
            self._tokens -= n
            self.backlog -= n
        return b"".join(out)

    def next_s(self) -> float | None:
        """Seconds until it is worth pulling again; None when idle."""
        return min(self.backlog / self.rate, BURST_S) if self.backlog else None

    def clear(self) -> None:
        self._queue.clear()
        self.backlog = 0


class BoardPort(Protocol):
    """One end of the line: raw bytes, never blocking, silent about a peer that is not there."""

    overrun: int

    @property
    def url(self) -> str: ...
    @property
    def deserted_s(self) -> float:
        """For how long a host that was connected has been gone, where that is to be seen; else 0."""

    def filenos(self) -> list[int]: ...
    def read(self) -> bytes: ...
    def write(self, data: bytes) -> None: ...
    def unplug(self) -> None: ...
    def plug(self, name: str = "") -> None: ...
    def close(self) -> None: ...


class PtyPort:
    """A pty, linked as <folder>/<name>. Its slave end is kept open: without any, the master sees errors."""

    deserted_s = 0.0  # whether a host has it open is not to be seen

    def __init__(self, folder: Path, name: str = "board") -> None:
        self.folder, self.name = folder, name
        self._url = ""
        self.overrun = 0
        self._master = self._slave = -1
        self._link: Path | None = None
        self._full_since = time.monotonic()
        self.plug()

    @property
    def url(self) -> str:
        """The pty's device path: another one after each unplug."""
        return self._url

    def plug(self, name: str = "") -> None:
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        attributes = termios.tcgetattr(self._slave)
        attributes[4] = attributes[5] = termios.B921600
        termios.tcsetattr(self._slave, termios.TCSANOW, attributes)
        os.set_blocking(self._master, False)
        self._url = os.ttyname(self._slave)
        self._link = _publish(self.folder / (name or self.name), self._url)

    def unplug(self) -> None:
        self._forget()
        for fd in (self._master, self._slave):
            if fd >= 0:
                os.close(fd)
        self._master = self._slave = -1

    close = unplug

    def filenos(self) -> list[int]:
        return [self._master] if self._master >= 0 else []

    def read(self) -> bytes:
        try:
            return os.read(self._master, 4096) if self._master >= 0 else b""
        except OSError:
            return b""

    def write(self, data: bytes) -> None:
        """Write; unread bytes are lost once the kernel's buffer is full, as on a real line."""
        if self._master < 0:
            return
        self._discard_unread()
        try:
            sent = os.write(self._master, data)
        except OSError:
            sent = 0
        self.overrun += len(data) - sent

    def _discard_unread(self) -> None:
        """Drop what no host reads for a while, as USB drivers do with a closed port: the next one gets fresh bytes."""
        unread = struct.unpack("i", fcntl.ioctl(self._slave, termios.FIONREAD, b"\0" * 4))[0]
        now = time.monotonic()
        if unread < UNREAD:
            self._full_since = now
        elif now - self._full_since > UNREAD_S:
            termios.tcflush(self._slave, termios.TCIFLUSH)
            self.overrun += unread

    def _forget(self) -> None:
        """Remove the link, unless it belongs to another board by now."""
        if self._link is not None:
            with contextlib.suppress(OSError):
                if os.readlink(self._link) == self.url:
                    self._link.unlink()
        self._link = None


class TcpPort:
    """A TCP server for pyserial's `socket://host:port`; the newest client has the board.

    <folder>/<name> becomes a link whose target is the URL, so that a reader finds it where it would find a pty.
    """

    def __init__(self, url: str, folder: Path, name: str = "board") -> None:
        self._host, self._port = tcp_address(url)
        self._link = folder / name
        self.overrun = 0
        self._server: socket.socket | None = None
        self._client: socket.socket | None = None
        self._deserted: float | None = None
        self.plug()

    @property
    def url(self) -> str:
        return f"socket://{self._host}:{self._port}"

    def plug(self, name: str = "") -> None:
        family = socket.AF_INET6 if ":" in self._host else socket.AF_INET
        server = socket.socket(family, socket.SOCK_STREAM)
        server.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            server.bind((self._host, self._port))
            server.listen(4)
        except OSError as error:
            server.close()
            raise OSError(f"cannot listen at {self.url}: {error.strerror or error}") from None
        server.setblocking(False)
        self._port = server.getsockname()[1]
        self._server = server
        _publish(self._link, self.url)

    def unplug(self) -> None:
        for end in (self._client, self._server):
            if end is not None:
                end.close()
        self._client = self._server = None

    close = unplug

    def filenos(self) -> list[int]:
        return [end.fileno() for end in (self._server, self._client) if end is not None]

    def read(self) -> bytes:
        self._accept()
        if self._client is None:
            return b""
        try:
            data = self._client.recv(4096)
        except BlockingIOError:
            return b""
        except OSError:
            data = b""
        if not data:
            self._desert()
        return data

    def write(self, data: bytes) -> None:
        if self._client is None:
            return
        try:
            self.overrun += len(data) - self._client.send(data)
        except BlockingIOError:
            self.overrun += len(data)
        except OSError:
            self._desert()

    def _desert(self) -> None:
        """The host has gone."""
        assert self._client is not None
        self._client.close()
        self._client, self._deserted = None, time.monotonic()

    @property
    def deserted_s(self) -> float:
        """For how long a host that was connected has been gone; 0 while one is there, and before the first."""
        return 0.0 if self._deserted is None else time.monotonic() - self._deserted

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError, OSError):
            if self._server is None:
                return
            client, _ = self._server.accept()
            if self._client is not None:
                self._client.close()
            client.setblocking(False)
            client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._client, self._deserted = client, None


def open_port(listen: str | None, folder: Path, name: str = "board") -> BoardPort:
    """A pty in `folder`, or a TCP server at `listen`. Raises ValueError for another kind of URL, OSError if taken."""
    return TcpPort(listen, folder, name) if listen else PtyPort(folder, name)


def _publish(link: Path, target: str) -> Path:
    """Make `link` point at `target`, in one step for whoever looks at it."""
    fresh = link.with_name(f".{link.name}.{os.getpid()}")
    with contextlib.suppress(FileNotFoundError):
        fresh.unlink()
    fresh.symlink_to(target)
    fresh.replace(link)
    return link


def tcp_address(url: str) -> tuple[str, int]:
    """Host and port of --listen. Raises ValueError."""
    parts = urlsplit(url if "://" in url else f"socket://{url}")
    try:
        port = parts.port
    except ValueError:
        port = None
    if parts.scheme not in ("socket", "tcp") or port is None:
        raise ValueError(f"--listen {url}: expected socket://HOST:PORT, for example socket://0.0.0.0:7000")
    return parts.hostname or "127.0.0.1", port
