"""A serial port as acquisition needs it: any pyserial URL, raw bytes, and a name that may change when it is plugged
in again.
"""

from __future__ import annotations

import contextlib
import errno
import os
import select
import socket
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import serial
from serial.tools import list_ports

from protocol.errors import EitskinError
from protocol.part_size import BAUD
from protocol.runtime import runtime_dir
from services.board.other_end import NETWORK, RFC2217, OtherEnd

STUB_LINKS = "board-"  # and the skin's name: the link to the stub's pty in the runtime folder


class PortError(EitskinError):
    """The port cannot be opened, or is gone. The text is for a person."""


class Port:
    """An open port. Raises PortError from every method once the device is gone."""

    def __init__(self, url: str, baud: int = BAUD) -> None:
        self.url = url
        try:
            made = serial.serial_for_url(url, baudrate=baud, timeout=0, exclusive=True, do_not_open=True)
            if url.lower().startswith(RFC2217):
                made._telnet_read_loop = _quiet(made._telnet_read_loop)
            else:
                made.write_timeout = 1
            if url.lower().startswith("socket://"):  # pyserial would throw away what the other end says first
                made.reset_input_buffer = lambda: None
            made.open()
        except Exception as why:  # by the kind of URL nearly any
            raise PortError(explain(url, why, baud)) from None
        self._serial: Any = made
        self._failed: Exception | None = None  # a write: what came before it is read first
        try:
            self._serial.set_low_latency_mode(True)
        except Exception:  # not every driver has it: ptys, sockets, other systems
            pass
        try:
            self._fd = int(self._serial.fileno())
        except Exception:  # rfc2217:// and loop:// have none
            self._fd = -1
        if self._fd < 0:
            self._serial.timeout = 0.02

    def read(self, timeout_s: float) -> bytes:
        """Returns what has arrived, waiting up to timeout_s for the first byte; b"" when nothing came."""
        try:
            if self._fd < 0:
                data: bytes = self._serial.read(1)
                data += self._serial.read(self._serial.in_waiting) if data else b""
                ready = bool(data)
            else:
                ready = bool(select.select([self._fd], [], [], 0.0 if self._failed else timeout_s)[0])
                data = os.read(self._fd, 65536) if ready else b""
        except Exception as why:  # of the system, and of a pyserial whose port was closed
            raise PortError(self._gone(self._failed or why)) from None
        if not data and (ready or self._failed):
            raise PortError(self._gone(self._failed))
        return data

    def write(self, data: bytes) -> None:
        """Where it fails, the next `read` says so, once it has given all that came before."""
        try:
            self._serial.write(data)
        except Exception as why:
            self._failed = why

    def close(self) -> None:
        try:
            self._serial.close()
        except Exception:  # a device that is gone may fail in any way
            pass

    def _gone(self, why: Exception | None) -> str:
        if isinstance(why, serial.SerialTimeoutException):
            return f"{self.url} takes no more bytes: nothing reads them at its other end; is that the board?"
        system = _system(why)
        said = f" ({system.strerror.lower()})" if system is not None and system.strerror else ""
        if self.url.lower().startswith(NETWORK):
            return f"{self.url} is gone{said}: did the gateway restart, or another program take its port?"
        return f"{self.url} is gone{said}: is the cable plugged in?"


def _quiet(listen: Callable[[], None]) -> Callable[[], None]:
    """A thread of pyserial's that prints no traceback where the other end speaks no telnet: what it sends is named."""

    def listening() -> None:
        with contextlib.suppress(Exception):
            listen()

    return listening


def _system(why: BaseException | None) -> OSError | None:
    """The failure of the system behind an exception: pyserial puts it into a text of its own."""
    while why is not None:
        if isinstance(why, OSError) and (why.errno or isinstance(why, TimeoutError)):
            return why
        if type(why).__module__ == "termios":
            return OSError(*why.args)
        why = why.__context__
    return None


def candidates(port: str, skin: str, usb_serial: str | None, known_board: bool) -> Iterator[str]:
    """Returns the URLs at which the skin's board may be: first the configured one, then, once we know it, the names it
    may have come back under.
    """
    if port == "stub":
        folder = runtime_dir()
        link = folder / f"{STUB_LINKS}{skin}"
        # A pty's path, or the URL of a stub that listens on a socket: ptys do not cross containers.
        target = os.readlink(link) if link.is_symlink() else ""
        yield target if "://" in target else str(link)
        if known_board:
            yield from (str(p) for p in sorted(folder.glob("board*")) if p.is_symlink() and p != link)
        return
    yield port
    if "://" in port or not known_board:
        return
    if usb_serial:
        yield from (p.device for p in list_ports.comports() if p.serial_number == usb_serial and p.device != port)
    else:
        path = Path(port)
        stem = path.name.rstrip("0123456789")
        yield from (
            str(p) for p in sorted(path.parent.glob(stem + "*")) if p != path and (p.is_symlink() or p.is_char_device())
        )


def usb_serial_number(url: str) -> str | None:
    """Returns the serial number of the USB device behind a device path, if it has one."""
    real = os.path.realpath(url) if "://" not in url else url
    return next((p.serial_number for p in list_ports.comports() if p.device == real), None)


def explain(url: str, why: Exception, baud: int = BAUD) -> str:
    """Returns what a failure to open means and what to do about it."""
    text, system = str(why), _system(why)
    number = None if system is None else system.errno
    if number in (errno.ENOENT, errno.ENOTDIR):
        if url.startswith(str(runtime_dir() / STUB_LINKS)):
            return "waiting for the stub board, which `skin up` starts"
        return f"{url} is not there: plug the board in, or correct `port` in skin.toml"
    if isinstance(system, socket.gaierror):
        return f"{url}: no computer has that name: correct `port` in skin.toml, or give the number of its address"
    if isinstance(system, TimeoutError) or number in UNREACHED:
        return f"{url} does not answer: is that computer on, and can this one reach it?"
    if url.lower().startswith(RFC2217) and (said := _without_telnet(url)):
        return said
    for numbers, words, said in FAILURES:
        if number in numbers or any(word in text for word in words):
            return said.format(url=url, baud=baud)
    return f"{url} cannot be opened ({text[:200]}): is it the board's port? Correct `port` in skin.toml"


def _without_telnet(url: str) -> str:
    """What is at the other end of an address that does not speak RFC 2217, by what it says of itself; "" where nothing
    is said.
    """
    parts, end = urlsplit(url), OtherEnd(url)
    try:
        with socket.create_connection((parts.hostname, parts.port or 0), LISTEN_S) as raw:
            until = time.monotonic() + LISTEN_S
            while data := raw.recv(4096):
                end.receive(data, [])
                if time.monotonic() > until:
                    return end.sentence()
    except OSError:
        return end.sentence() if end.answered else ""
    return end.closed("")


LISTEN_S = 0.5
UNREACHED = (errno.ETIMEDOUT, errno.EHOSTUNREACH, errno.ENETUNREACH, errno.EHOSTDOWN)
FAILURES: tuple[tuple[tuple[int, ...], tuple[str, ...], str], ...] = (  # error numbers, or words of pyserial's text
    (
        (errno.EBUSY, errno.EAGAIN),
        ("exclusively lock",),
        "{url} is held by another program: close that one (`fuser {url}` names it)",
    ),
    (
        (errno.EACCES, errno.EPERM),
        (),
        "{url} may not be opened: add yourself to its group (`ls -l {url}`; usually dialout) and log in again",
    ),
    ((errno.ECONNREFUSED,), (), "nobody listens at {url}: start the gateway there, or correct `port` in skin.toml"),
    (
        (errno.ECONNRESET, errno.EPIPE, errno.ECONNABORTED),
        (),
        "{url} closes the connection at once: is it in use by another program? Close that one",
    ),
    (
        (errno.ENOTTY, errno.EISDIR, errno.EINVAL, errno.ENXIO, errno.ENODEV),
        (),
        "{url} is no serial device that works: correct `port` in skin.toml, or plug the board in again",
    ),
    ((), ("regexp",), "{url} matches no port: plug the board in (`python -m serial.tools.list_ports -v` lists ports)"),
    (
        (),
        ("RFC2217", "RFC 2217", "baud"),
        "{url} does not let itself be set to {baud} baud: of a gateway that does not speak RFC 2217 write "
        "socket://HOST:PORT; else correct `baud` in skin.toml",
    ),
)
