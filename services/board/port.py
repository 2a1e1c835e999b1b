"""A serial port as acquisition needs it: any pyserial URL, raw bytes, and a name that may change when it is plugged
in again.
"""

from __future__ import annotations

import os
import re
import select
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import serial
from serial.tools import list_ports

from protocol.errors import EitskinError
from protocol.part_size import BAUD
from protocol.runtime import runtime_dir

STUB_LINKS = "board-"  # and the skin's name: the link to the stub's pty in the runtime folder


class PortError(EitskinError):
    """The port cannot be opened, or is gone. The text is for a person."""


class Port:
    """An open port. Raises PortError from every method once the device is gone."""

    def __init__(self, url: str, baud: int = BAUD) -> None:
        self.url = url
        try:
            self._serial: Any = serial.serial_for_url(url, baudrate=baud, timeout=0, write_timeout=1, exclusive=True)
        except (serial.SerialException, OSError, ValueError, LookupError, re.error) as why:  # by the kind of URL
            raise PortError(explain(url, why)) from None
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
                return data + self._serial.read(self._serial.in_waiting) if data else data
            if not select.select([self._fd], [], [], timeout_s)[0]:
                return b""
            data = os.read(self._fd, 65536)
        except (OSError, ValueError, TypeError, serial.SerialException) as why:
            raise PortError(f"{self.url} is gone ({_plain(why)}): is the cable plugged in?") from None
        if not data:
            raise PortError(f"{self.url} is gone (ready to read, but nothing to be read): is the cable plugged in?")
        return data

    def write(self, data: bytes) -> None:
        try:
            self._serial.write(data)
        except (OSError, serial.SerialException) as why:
            raise PortError(f"{self.url} is gone ({_plain(why)}): is the cable plugged in?") from None

    def close(self) -> None:
        try:
            self._serial.close()
        except Exception:  # a device that is gone may fail in any way
            pass


def _plain(why: Exception) -> str:
    """What the system says, without its number; pyserial puts a failure of the system into a text of its own."""
    system = why if isinstance(why, OSError) and why.strerror else why.__context__
    return system.strerror.lower() if isinstance(system, OSError) and system.strerror else str(why)


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


def explain(url: str, why: Exception) -> str:
    """Returns what a failure to open means and what to do about it."""
    text, number = str(why), getattr(why, "errno", None)
    if "exclusively lock" in text or number in (11, 16):
        return f"{url} is held by another program: close that one (`fuser {url}` names it)"
    if number == 2 or "No such file" in text:
        if url.startswith(str(runtime_dir() / STUB_LINKS)):
            return "waiting for the stub board, which `skin up` starts"
        return f"{url} is not there: plug the board in, or correct `port` in skin.toml"
    if number == 13 or "Permission denied" in text:
        return f"{url} may not be opened: add yourself to its group (`ls -l {url}`; usually dialout) and log in again"
    return f"{url} cannot be opened: {text}"
