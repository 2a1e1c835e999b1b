"""python -m firmware_stub: boards on ptys in the runtime folder, their sheets, one control socket and the truth."""

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
from collections.abc import Iterable

import zmq

from models.bundle import BundleError
from models.mismatch import NAMED
from protocol import logs
from protocol.errors import in_words
from protocol.frame_types import NAME
from protocol.part_size import BAUD
from protocol.runtime import RuntimeDirError, control_endpoint, runtime_dir
from protocol.sockets import ControlClient, ControlError, Publisher
from protocol.transport import TransportError

from . import scene as scenes
from .control import Control
from .faults import FAULTS
from .port import open_port, tcp_address
from .rig import Rig
from .stub_skin import StubSkin, link_name, unique_id
from .worlds.table import WORLDS

log = logging.getLogger("stub")
PARENT_CHECK_S = 0.5
SKIN = "palm"


def arguments(argv: list[str] | None = None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(
        prog="firmware_stub", description="Skins' impedance boards, without the hardware: one board for each --skin."
    )
    add = parser.add_argument
    add("--skin", action="append", metavar="NAME[=SHEET]", help=f"a skin's name, and its sheet (default: {SKIN})")
    add(
        "--geometry",
        default="square16",
        metavar="SHEET",
        help="sheet of skins that name none: a skin of models/skins, a .toml file or a bundle's folder "
        "(default: %(default)s)",
    )
    add(
        "--mismatch",
        action="append",
        metavar="[SKIN=]NAME",
        help="by what a sheet, or every sheet, differs from what its file says: a name of models/mismatch.py (mild)",
    )
    add(
        "--world",
        action="append",
        metavar="[SKIN=]NAME",
        help="what a skin, or every skin, does beside, as real ones do: a name of worlds/table.py (creep)",
    )
    add("--scene", default="demo", help=f"one of {', '.join(scenes.names())}, or a .toml file (default: %(default)s)")
    add(
        "--snr",
        type=float,
        default=80.0,
        help="signal over noise in dB, with the paper's setting (default: %(default)s)",
    )
    add("--floor", type=float, default=0.0, help="noise floor in ohm (default: %(default)s)")
    add("--offset", type=float, default=0.0, metavar="MV", help="spread of the electrodes' steady offsets (default: 0)")
    add("--wander", type=float, default=0.0, metavar="MV", help="what these offsets wander by in minutes (default: 0)")
    add("--mains", type=float, default=0.0, metavar="MV", help="mains between two electrodes, amplitude (default: 0)")
    add("--rate", type=float, help="full scans per second (default: as the real board, about 22)")
    add("--ppm", type=float, default=12.0, help="how much too fast the board's crystal is (default: %(default)s)")
    add(
        "--baud",
        action="append",
        metavar="[SKIN=]RATE",
        help=f"bit rate of the line of a skin, or of every skin (default: {BAUD})",
    )
    add("--listen", metavar="URL", help="socket://HOST:PORT instead of a pty; further skins take the ports after it")
    add("--leave", type=float, metavar="SECONDS", help="end when a host that was connected has been gone for so long")
    add(
        "--seed",
        type=int,
        default=os.environ.get("EITSKIN_STUB_SEED"),
        help="of the noise (default: $EITSKIN_STUB_SEED, else another one each time)",
    )
    add("--no-time", action="store_true", help="a firmware that does not answer TIME_ASK")
    add("--detached", action="store_true", help="go on when the parent process has ended")
    add("--faults", action="store_true", help="list what can go wrong on request, and end")
    options = parser.parse_args(argv)
    options.skins = {}
    for text in options.skin or [SKIN]:
        name, _, sheet = text.partition("=")
        if not re.fullmatch(NAME, name):
            parser.error(f"--skin {text!r}: expected a name of letters, digits, '.', '_' or '-', or NAME=SHEET")
        if name in options.skins:
            parser.error(f"--skin {name!r} is given twice: expected one board for each skin")
        options.skins[name] = sheet or options.geometry
    options.mismatches = _of_skins(parser, options.skins, "--mismatch", options.mismatch, NAMED, "none")
    options.worlds = _of_skins(parser, options.skins, "--world", options.world, WORLDS, "")
    options.bauds = _bauds(parser, options.skins, options.baud)
    if any(world and options.mismatches[name] != "none" for name, world in options.worlds.items()):
        parser.error("--world and --mismatch of one skin: a world has a sheet of its own; expected one of them")
    if options.rate is not None and not 0.1 <= options.rate <= 10_000:
        parser.error(f"--rate {options.rate:g}: expected 0.1 to 10000 full scans per second")
    for name, value, low, high in (
        ("--snr", options.snr, 0, 200),
        ("--floor", options.floor, 0, 1e3),
        ("--offset", options.offset, 0, 1e3),
        ("--wander", options.wander, 0, 1e3),
        ("--mains", options.mains, 0, 1e3),
        ("--ppm", options.ppm, -5e4, 5e4),
        *(("--baud", baud, 1200, 1e8) for baud in options.bauds.values()),
    ):
        if not low <= value <= high:
            parser.error(f"{name} {value:g}: expected {low:g} to {high:g}")
    return options


def _of_skins(
    parser: argparse.ArgumentParser,
    skins: Iterable[str],
    option: str,
    given: list[str] | None,
    allowed: Iterable[str],
    default: str,
) -> dict[str, str]:
    """Each skin's name of what an option names as [SKIN=]NAME; ends the program where there is no such skin or name."""
    found = dict.fromkeys(skins, default)
    for text in given or []:
        skin, _, name = text.rpartition("=")
        if skin and skin not in found:
            parser.error(f"{option} {text!r}: no skin {skin!r}; expected one of {', '.join(found)}")
        if name not in allowed:
            parser.error(f"{option} {text!r}: expected one of {', '.join(allowed)}")
        found |= dict.fromkeys([skin] if skin else found, name)
    return found


def _bauds(parser: argparse.ArgumentParser, skins: Iterable[str], given: list[str] | None) -> dict[str, int]:
    """Each skin's rate of what --baud says as [SKIN=]RATE; ends the program where there is no such skin or rate."""
    rates = [text.rpartition("=")[2] for text in given or []]
    for rate in rates:
        if not rate.isdecimal():
            parser.error(f"--baud {rate!r}: expected a whole number of bits a second")
    named = _of_skins(parser, skins, "--baud", given, rates, str(BAUD))
    return {name: int(rate) for name, rate in named.items()}


def main(argv: list[str] | None = None) -> int:
    options = arguments(argv)
    if options.faults:
        for name, row in FAULTS.items():
            print(f"{name:20s} {row.what}  {dict(row.args) or ''}")
        return 0
    logs.setup("stub: %(message)s")
    stop = _Stop()
    parent = None if options.detached else os.getppid()
    skins: dict[str, StubSkin] = {}
    context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
    publisher = control = None
    try:
        begin_ns = _open(options, skins)
        publisher = Publisher("stub", context)
        rigs = {name: skin.rig for name, skin in skins.items()}
        control = Control(rigs, lambda: (time.monotonic_ns() - begin_ns) * 1e-9, context, begin_ns)
        for name, skin in skins.items():
            sheet = "" if skin.rig.sheet.mismatch == "none" else f", mismatch {skin.rig.sheet.mismatch}"
            log.info("board of %s at %s, scene %s%s", name, skin.port.url, options.scene, sheet)
        _run(list(skins.values()), publisher, stop, parent, options.leave)
    except (ValueError, OSError, RuntimeDirError, BundleError) as error:
        log.error("%s", in_words(error))
        return 2
    except (zmq.ZMQError, TransportError) as error:
        log.error("sockets: %s", error)
        return 1
    finally:
        if control is not None:
            control.close()
        if publisher is not None:
            publisher.close()
        for skin in skins.values():
            skin.close()
        context.destroy(linger=0)
    return 0


def _open(options: argparse.Namespace, skins: dict[str, StubSkin]) -> int:
    """Open a stub skin, each at a port of its own, for each that is asked for; returns when they began [ns]."""
    host, first = tcp_address(options.listen) if options.listen else ("", 0)
    _alone()
    rigs = {
        name: Rig(
            sheet,
            mismatch=options.mismatches[name],
            scene=options.scene,
            snr_db=options.snr,
            floor_ohm=options.floor,
            rate_hz=options.rate,
            offset_v=options.offset * 1e-3,
            wander_v=options.wander * 1e-3,
            mains_v=options.mains * 1e-3,
            crystal_ppm=options.ppm,
            baud=options.bauds[name],
            seed=None if options.seed is None else options.seed + n,
            unique_id=unique_id(name),
            threaded=True,
            world=options.worlds[name],
            answers_time=not options.no_time,
        )
        for n, (name, sheet) in enumerate(options.skins.items())
    }
    begin_ns = time.monotonic_ns()
    for n, (name, rig) in enumerate(rigs.items()):
        listen = f"socket://{f'[{host}]' if ':' in host else host}:{first + n if first else 0}" if host else None
        skins[name] = StubSkin(name, rig, open_port(listen, runtime_dir(), link_name(name)), begin_ns)
    return begin_ns


def _alone() -> None:
    """Raises RuntimeDirError where another stub answers in this runtime folder: we would take over its sockets."""
    with contextlib.suppress(ControlError):
        if os.path.exists(control_endpoint("stub").removeprefix("ipc://")):
            ControlClient("stub", 0.3).call("clock")
            raise RuntimeDirError(
                f"another stub runs in {runtime_dir()}: stop it, or set EITSKIN_RUNTIME to another folder"
            )


def _run(
    skins: list[StubSkin], publisher: Publisher, stop: _Stop, parent: int | None, leave_s: float | None = None
) -> None:
    """Until a signal, the parent's end, or no host at any port for leave_s."""
    checked = 0.0
    while not stop.asked:
        for skin in skins:
            skin.step(publisher)
        if time.monotonic() - checked > PARENT_CHECK_S:
            checked = time.monotonic()
            publisher.poll()
            publisher.mind()
            if parent is not None and os.getppid() != parent:
                log.info("the parent process has ended")
                return
            if leave_s is not None and all(skin.port.deserted_s > leave_s for skin in skins):
                log.info("no host for %g s: ending", leave_s)
                return
        ports = [number for skin in skins for number in skin.port.filenos()]
        select.select([*ports, stop.fileno()], [], [], min(skin.wake_s for skin in skins))


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
