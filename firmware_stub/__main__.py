"""python -m firmware_stub: the board on a pty in the runtime folder, its sheet, its control socket and the truth."""

from __future__ import annotations

import argparse
import contextlib
import logging
import os
import re
import select
import signal
import socket
import sys
import time

import zmq

from protocol import logs
from protocol.frame_types import NAME
from protocol.runtime import RuntimeDirError, control_endpoint, runtime_dir
from protocol.sockets import ControlClient, ControlError, Publisher
from protocol.transport import TransportError

from . import scene as scenes
from .control import Control
from .faults import FAULTS
from .port import Port, open_port, tcp_address
from .rig import Rig
from .status import Status
from .truth import truth_frame

log = logging.getLogger("stub")
PARENT_CHECK_S = 0.5


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="firmware_stub", description="A skin's impedance board, without the hardware."
    )
    add = parser.add_argument
    add("--skin", default="palm", help="name the truth is published under (default: %(default)s)")
    add("--geometry", default="square16", help="skin of models/skins, or a .toml file (default: %(default)s)")
    add("--scene", default="demo", help=f"one of {', '.join(scenes.names())}, or a .toml file (default: %(default)s)")
    add("--snr", type=float, default=80.0, help="signal over noise in dB, at 128 DFT points (default: %(default)s)")
    add("--floor", type=float, default=0.0, help="noise floor in ohm (default: %(default)s)")
    add("--rate", type=float, help="full scans per second (default: as the real board, about 22)")
    add("--ppm", type=float, default=12.0, help="how much too fast the board's crystal is (default: %(default)s)")
    add("--baud", type=int, default=921_600, help="bit rate of the line (default: %(default)s)")
    add("--listen", metavar="URL", help="socket://HOST:PORT instead of a pty")
    add("--port-name", default="board", help="the pty's name in the runtime folder (default: %(default)s)")
    add("--leave", type=float, metavar="SECONDS", help="end when a host that was connected has been gone for so long")
    add("--seed", type=int, help="of the noise (default: another one each time)")
    add("--detached", action="store_true", help="go on when the parent process has ended")
    add("--faults", action="store_true", help="list what can go wrong on request, and end")
    options = parser.parse_args(argv)
    if not re.fullmatch(NAME, options.skin):
        parser.error(f"--skin {options.skin!r}: expected letters, digits, '.', '_' or '-'")
    if options.rate is not None and not 0.1 <= options.rate <= 10_000:
        parser.error(f"--rate {options.rate:g}: expected 0.1 to 10000 full scans per second")
    for name, value, low, high in (
        ("--snr", options.snr, 0, 200),
        ("--floor", options.floor, 0, 1e3),
        ("--ppm", options.ppm, -5e4, 5e4),
        ("--baud", options.baud, 1200, 1e8),
    ):
        if not low <= value <= high:
            parser.error(f"{name} {value:g}: expected {low:g} to {high:g}")
    return options


def main(argv: list[str] | None = None) -> int:
    options = arguments(argv)
    if options.faults:
        for name, row in FAULTS.items():
            print(f"{name:20s} {row.what}  {dict(row.args) or ''}")
        return 0
    logs.setup("stub: %(message)s")
    stop = _Stop()
    parent = None if options.detached else os.getppid()
    try:
        if options.listen:
            tcp_address(options.listen)
        _alone()
        rig = Rig(
            options.geometry,
            scene=options.scene,
            snr_db=options.snr,
            floor_ohm=options.floor,
            rate_hz=options.rate,
            crystal_ppm=options.ppm,
            baud=options.baud,
            seed=options.seed,
            threaded=True,
        )
        port = open_port(options.listen, runtime_dir(), options.port_name)
    except (ValueError, OSError, RuntimeDirError) as error:
        log.error("%s", error)
        return 2
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    begin_ns = time.monotonic_ns()
    publisher = control = None
    try:
        publisher = Publisher("stub", context)
        control = Control(rig, options.skin, lambda: (time.monotonic_ns() - begin_ns) * 1e-9, context)
        log.info("board at %s, scene %s", port.url, options.scene)
        _run(rig, port, publisher, options.skin, begin_ns, stop, parent, options.leave)
    except (zmq.ZMQError, TransportError) as error:
        log.error("sockets: %s", error)
        return 1
    finally:
        port.close()
        if control is not None:
            control.close()
        if publisher is not None:
            publisher.close()
        rig.close()
        context.destroy(linger=0)
    return 0


def _alone() -> None:
    """Raises RuntimeDirError where another stub answers in this runtime folder: we would take over its sockets."""
    with contextlib.suppress(ControlError):
        if os.path.exists(control_endpoint("stub").removeprefix("ipc://")):
            ControlClient("stub", 0.3).call("clock")
            raise RuntimeDirError(
                f"another stub runs in {runtime_dir()}: stop it, or set EITSKIN_RUNTIME to another folder"
            )


def _run(
    rig: Rig,
    port: Port,
    publisher: Publisher,
    skin: str,
    begin_ns: int,
    stop: _Stop,
    parent: int | None,
    leave_s: float | None = None,
) -> None:
    """Until a signal, the parent's end, or no host for leave_s: hand bytes to and fro, publish what was true."""
    name, gone = "", False
    checked, written_ns = 0.0, begin_ns
    status = Status(skin)
    while not stop.asked:
        now = (time.monotonic_ns() - begin_ns) * 1e-9
        if data := port.read():
            rig.feed(data, now)
        if sent := rig.pull(now):
            written_ns = time.monotonic_ns()  # before the write: its reader may run before we do again
            port.write(sent)
        if (rig.unplugged is not None) != gone:
            gone = not gone
            if gone:
                assert rig.unplugged is not None
                name = rig.unplugged["name"]
                port.unplug()
                log.info("unplugged")
            else:
                port.plug(name)
                log.info("plugged in again as %s %s", port.url, name)
        # A scan's last byte has left when the line has nothing left to send, or has gone on to the scans after it.
        while rig.scans and (not rig.line.backlog or len(rig.scans) > 1):
            scan, world, middle = rig.scans.popleft()
            stamps = {"sample": begin_ns + round(middle * 1e9), "publish": written_ns}
            publisher.send(truth_frame(skin, rig.sheet, scan, world, stamps))
            status.scanned()
        if (due := status.due(rig, port, now)) is not None:
            publisher.send(due)
        if now - checked > PARENT_CHECK_S:
            checked = now
            publisher.poll()
            publisher.mind()
            if parent is not None and os.getppid() != parent:
                log.info("the parent process has ended")
                return
            if leave_s is not None and port.deserted_s > leave_s:
                log.info("no host for %g s: ending", leave_s)
                return
        select.select([*port.filenos(), stop.fileno()], [], [], rig.wake_s((time.monotonic_ns() - begin_ns) * 1e-9))


class _Stop:
    """SIGINT and SIGTERM, as something that `select` can wait for."""

    def __init__(self) -> None:
        self.asked = False
        self._read, self._write = socket.socketpair()
        self._write.setblocking(False)
        self._read.setblocking(False)
        signal.set_wakeup_fd(self._write.fileno(), warn_on_full_buffer=False)
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._ask)

    def _ask(self, number: int, frame: object) -> None:
        self.asked = True

    def fileno(self) -> int:
        return self._read.fileno()


if __name__ == "__main__":
    sys.exit(main())
