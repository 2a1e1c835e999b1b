"""`skin doctor`: what stands between a skin and its contacts. Works with the service up or down; changes nothing."""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.bundle import Bundle, BundleError
from protocol import transport
from protocol.link import SCHEMA_HASH
from protocol.part_size import line_load
from protocol.runtime import RuntimeDirError, runtime_dir
from services.board import port as ports
from services.board.boardlink import BoardLink
from services.board.other_end import OtherEnd
from services.board.scanning import Scanning
from services.cli import doctor_live as live
from services.cli.doctor_live import Finding
from services.cli.doctor_mounting import mounting_found
from services.contacts.force.law import ForceLaw, known_radius
from services.contacts.surface import placement
from services.describe import ON, geometry, symmetry
from services.estimation.faults import advice
from services.estimation.initialisation.baseline import implausibility
from services.runtime import room
from services.runtime.config import RECORDINGS, ConfigError, Skin, config_path, load
from services.runtime.stage import PROCESSES
from services.runtime.supervision import programs

BOARD_S = 2.5  # for a board to say who it is
LATENCY_TIMER_MS = 1
GOOD_CLOCKS = ("tsc", "arch_sys_counter", "kvm-clock", "hyperv_clocksource_tsc_page")
GOOD_FIT = 0.01  # relative misfit of |Z0| to the bundle's prediction
SWAP_GAIN = 3.0  # a swap of two electrodes is suspected where it makes the fit so many times better


def examine(path: Path | None = None) -> list[Finding]:
    """Examine everything, in the order in which it must be right."""
    return list(_examine(path))


def _examine(path: Path | None) -> Iterator[Finding]:
    try:
        config = load(path)
        transport.configure(config.transport())
        yield Finding("OK", "configuration", f"{config_path(path)}: skin {', '.join(config.skins)}")
    except (ConfigError, transport.TransportError) as why:
        yield Finding("FAIL", "configuration", str(why).replace("\n", "; "))
        return
    try:
        folder = runtime_dir()
        for process in PROCESSES:
            transport.current().control_address(process)  # a socket's path may be too long
    except RuntimeDirError as why:
        yield Finding("FAIL", "runtime folder", str(why))
        return
    running = live.running()
    ours = running and live.another(config.path) is None
    yield Finding("OK", "runtime folder", f"{folder}, {'a service runs' if running else 'no service runs'} there")
    if running:
        yield from live.configuration(config.path)
    else:
        lacking = room.lacking(len(programs(config)) + 1, len(config.skins), folder)
        yield from (Finding("FAIL", "room", each) for each in lacking)
    yield _clock()
    for name, skin in config.skins.items():
        yield from _skin(name, skin, running, ours)


def _clock() -> Finding:
    file = Path("/sys/devices/system/clocksource/clocksource0/current_clocksource")
    try:
        source = file.read_text().strip()
    except OSError:
        return Finding("SKIP", "clock", f"{file} cannot be read here")
    if source in GOOD_CLOCKS:
        return Finding("OK", "clock", f"monotonic clock from {source}")
    return Finding("WARN", "clock", f"the kernel's clock source is {source}, slow to read; expected {GOOD_CLOCKS[0]}")


def _skin(name: str, skin: Skin, running: bool, ours: bool) -> Iterator[Finding]:
    """running: whether a service runs, and holds boards; ours: whether with this configuration, so that it can be
    asked.
    """
    try:
        bundle = Bundle.load(skin.bundle)
    except BundleError as why:
        yield Finding("FAIL", f"{name}: bundle", str(why))
        return
    network = (
        "with its network" if bundle.network_path(skin.network if skin.network != "none" else "full") else "no network"
    )
    yield Finding("OK", f"{name}: bundle", f"{bundle.name}, every sha256 right ({bundle.hash[:12]}), {network}")
    yield Finding("OK", f"{name}: checks", advice.unchecked(bundle) or "all of them, on every frame")
    try:
        known_radius(skin, bundle, name)
    except ConfigError as why:
        yield Finding("FAIL", f"{name}: indenter", str(why))
        return
    if not ours:
        yield from options(name, skin, {"symmetry": symmetry(skin, bundle)})
    if skin.calibration is not None:
        yield _calibration(name, skin, bundle)
    if skin.reads is not None:
        yield _reads(name, skin, bundle)
    if skin.surface is not None:
        yield _wrapped(name, skin, bundle)
    yield from _port(name, skin, bundle, running, ours)
    if skin.port != "stub":
        yield from _latency_timer(name, skin)
    if ours:
        yield from _live(name, skin, bundle)
    elif running:
        yield Finding("SKIP", f"{name}: contacts", "not asked for: the service runs another configuration, see above")
    else:
        yield Finding("SKIP", f"{name}: electrodes", "their order is looked at while the service runs: `skin up`")


def _port(name: str, skin: Skin, bundle: Bundle, running: bool, ours: bool) -> Iterator[Finding]:
    what = f"{name}: port"
    if Path(skin.port).suffix in RECORDINGS:
        found = Path(skin.port).is_file()
        yield Finding("OK" if found else "FAIL", what, f"{skin.port} {'is' if found else 'is not'} there")
    elif ours:
        yield from live.port(name, skin)
    elif skin.port == "stub":
        yield Finding("OK", what, "the stub board, which `skin up` starts")
    elif running:
        yield Finding("SKIP", what, f"{skin.port} is not opened: a service runs, which may use it")
    else:
        yield from _device(name, skin, bundle)


def _live(name: str, skin: Skin, bundle: Bundle) -> Iterator[Finding]:
    """What the service that runs this configuration says of a skin."""
    live.wait_for_baseline(name)
    yield from live.processes(name)
    yield from live.contacts(name)
    info = live.info(name)
    yield from live.compared(name, skin, bundle, info)
    yield from options(name, skin, info)
    said = info.get("mounting")
    if isinstance(said, dict):
        yield mounting_found(name, said, info)
    if not isinstance(said, dict) or not float(said.get("misfit", 1.0)) <= GOOD_FIT:
        yield electrode_order(name, live.baseline(info), bundle)


def options(name: str, skin: Skin, info: dict[str, Any]) -> Iterator[Finding]:
    """Whether what skin.toml asks for is done, or why not. info: of info/<skin>."""
    if skin.touch.symmetry and isinstance(said := info.get("symmetry"), str):
        on, good = said == ON, "a held touch's image becomes the mean over the symmetries"
        yield Finding("OK" if on else "WARN", f"{name}: symmetry", good if on else f"symmetry {said}")


def _wrapped(name: str, skin: Skin, bundle: Bundle) -> Finding:
    what = f"{name}: surface"
    try:
        _, frame_id = placement(skin, geometry(bundle)["outline"], name)
    except ConfigError as why:
        return Finding("FAIL", what, str(why))
    assert skin.surface is not None
    return Finding("OK", what, f"{skin.surface.kind} of radius {skin.surface.radius_m:g} m; contacts in {frame_id!r}")


def _calibration(name: str, skin: Skin, bundle: Bundle) -> Finding:
    what = f"{name}: calibration"
    if skin.calibration is None or not skin.calibration.is_file():
        return Finding("FAIL", what, f"{skin.calibration} is not there: correct `calibration`, or take the line away")
    try:
        law = ForceLaw.of(skin, bundle, name)
    except ConfigError as why:
        return Finding("FAIL", what, f'{why}; expected JSON such as {{"newtons_per_siemens": 10.0, "most_n": 5.0}}')
    return Finding("OK", what, f"{skin.calibration}: {law}")


def _reads(name: str, skin: Skin, bundle: Bundle) -> Finding:
    try:
        return Finding("OK", f"{name}: reads", f"{skin.reads}: {ForceLaw.of(skin, bundle, name)}")
    except ConfigError as why:
        return Finding("FAIL", f"{name}: reads", str(why))


def _device(name: str, skin: Skin, bundle: Bundle) -> Iterator[Finding]:
    what = f"{name}: port"
    try:
        port = ports.Port(skin.port, skin.baud)
    except ports.PortError as why:
        yield Finding("FAIL", what, str(why))
        return
    try:
        yield Finding("OK", what, f"{skin.port} opens")
        yield _board(name, skin, bundle, port)
        yield from _line(name, skin, bundle)
    finally:
        port.close()


def _latency_timer(name: str, skin: Skin) -> Iterator[Finding]:
    timer = Path("/sys/bus/usb-serial/devices", Path(os.path.realpath(skin.port)).name, "latency_timer")
    if timer.is_file():
        found = int(timer.read_text())
        good = found <= LATENCY_TIMER_MS
        todo = "" if good else f": it delays every frame; echo {LATENCY_TIMER_MS} | sudo tee {timer}"
        yield Finding("OK" if good else "WARN", f"{name}: latency timer", f"{found} ms{todo}")


def _line(name: str, skin: Skin, bundle: Bundle) -> Iterator[Finding]:
    """Whether the line carries the scans."""
    load = line_load(len(bundle.pattern), 1, skin.setting, skin.baud)
    if load > 1:
        todo = f"scans take {load:.1f} times as long on the line as to measure, so most are lost: raise `baud`"
        yield Finding("WARN", f"{name}: line", f"{skin.baud} baud at {skin.setting}: {todo}")


def _board(name: str, skin: Skin, bundle: Bundle, port: ports.Port) -> Finding:
    """Ask the board who it is; it is not started."""
    what, began = f"{name}: board", time.monotonic()
    link = BoardLink(Scanning(bundle.pattern, skin.setting, skin.rtia_ohm), began, OtherEnd(port.url, skin.baud))
    try:
        while (now := time.monotonic()) < began + BOARD_S and link.ident is None:
            if link.state == "hello" and (due := link.to_send(now)):
                port.write(due)
            link.received(port.read(0.05), time.monotonic())
    except ports.PortError as why:
        return Finding("FAIL", what, link.lost(str(why)))
    if link.ident is None or link.state == "refused":
        return Finding("FAIL", what, link.problem)
    ours = f"{link.board}, firmware {link.ident.firmware!r}, schema {SCHEMA_HASH:08x} as ours"
    rate = 1 / skin.setting.scan_s(len(bundle.pattern))
    return Finding("OK", what, f"{ours}; to scan at {skin.setting}: {rate:.1f} a second")


def electrode_order(name: str, z0: NDArray[np.float64] | None, bundle: Bundle) -> Finding:
    """Whether the baseline looks as the bundle predicts, and whether exchanging two electrodes would make it so."""
    what, pre = f"{name}: electrodes", bundle.prereconstructor()
    if z0 is None or len(z0) != len(bundle.pattern):
        return Finding("SKIP", what, "no baseline yet to see their order by")
    if pre.m.normalisation != "model":
        return Finding("SKIP", what, f"bundle {bundle.name} does not predict impedances, so their order cannot be seen")
    if not (z0 > 0).any():
        return Finding("FAIL", what, "every impedance of the baseline is zero: free the skin and run `skin tare`")
    misfit = implausibility(z0, pre)
    if misfit <= GOOD_FIT:
        return Finding("OK", what, f"in order: the baseline is {100 * misfit:.2f} % off the bundle's prediction")
    place = {_key(row): k for k, row in enumerate(bundle.pattern.tolist())}
    fits = []
    for i, j in itertools.combinations(range(int(bundle.pattern.max()) + 1), 2):
        order = [place.get(_key([{i: j, j: i}.get(e, e) for e in row])) for row in bundle.pattern.tolist()]
        if None not in order:
            fits.append((implausibility(z0[np.array(order)], pre), i, j))
    best, i, j = min(fits, default=(np.inf, 0, 0))
    if best * SWAP_GAIN < misfit:
        text = f"electrodes {i} and {j} look exchanged: the baseline is {100 * misfit:.0f} % off as it is, "
        return Finding("FAIL", what, text + f"{100 * best:.1f} % with them exchanged; check their wires")
    text = f"the baseline is {100 * misfit:.1f} % off the bundle's prediction: free the skin and run `skin tare`; "
    return Finding("WARN", what, text + "if it stays, check the wiring and that this is the right bundle")


def _key(row: list[int]) -> frozenset[frozenset[int]]:
    """Reciprocity: drive and sense pairs may change places, and each may be turned round."""
    return frozenset((frozenset(row[:2]), frozenset(row[2:])))
