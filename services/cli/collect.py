"""`skin collect`: presses at known places into a file, by prompts, or by itself on the stub."""

from __future__ import annotations

import math
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from services.cli.common import (
    USAGE,
    JsonOption,
    SkinOption,
    config_file,
    control,
    emit,
    fail,
    of_service,
    skin_name,
    use_configured_sockets,
)

if TYPE_CHECKING:
    from models.bundle import Bundle
    from services.calibration.collecting import Collected, Collector

FORCES = (3.0, 1.5, 5.0, 2.0, 4.0)  # newtons with which the stub is pressed, in turn
STUB_PATIENCE_S = 20.0  # a press of the stub is there at once, or not seen at all
MOST_PRESSES = 2000  # a day's work of a machine
MOST_FAILED = 3  # presses in a row that do not count: the next ones will not either


def register(app: typer.Typer) -> None:
    app.command()(of_service(collect))


def collect(
    target: Annotated[Path, typer.Argument(metavar="OUT.npz", help="What `skin register` reads.")],
    stub: Annotated[
        int, typer.Option(metavar="N", min=0, max=MOST_PRESSES, help="Press the stub by itself, at N places.")
    ] = 0,
    radius: Annotated[
        float, typer.Option(metavar="METRES", min=1e-4, max=0.1, help="With --stub: of the indenter.")
    ] = 0.005,
    skin: SkinOption = "",
    as_json: JsonOption = False,
) -> None:
    """Collect presses at known places on the running skin: for `skin register` and `skin calibrate force`.

    By prompts: type x and y in millimetres (and newtons, if known), press there and hold still, release when told; an
    empty line ends. A CSV of the forces is written beside OUT.npz where every press has one.
    """
    from models.bundle import Bundle
    from protocol.sockets import AllReader
    from services.calibration import collecting
    from services.calibration.force_presses import PATIENCE_S
    from services.calibration.seen import TouchReader
    from services.runtime.config import load

    if target.suffix != ".npz":
        fail(f"found {target.name}, expected a name ending in .npz", USAGE)
    if not target.parent.is_dir():
        fail(f"no folder {target.parent} to write {target.name} to: make it first", USAGE)
    name = skin_name(skin)
    configured = load(config_file()).skin(name)
    bundle = Bundle.load(configured.bundle)
    if stub and configured.port != "stub":
        fail(f'--stub presses a skin with port = "stub"; {name} has {configured.port!r}: leave it out', USAGE)
    use_configured_sockets()
    reader = AllReader(["raw", "image"], name)
    try:
        patience_s = STUB_PATIENCE_S if stub else PATIENCE_S
        collector = collecting.Collector(reader, TouchReader(configured, bundle), time.monotonic, patience_s)
        presses = _on_the_stub(collector, name, bundle, stub, radius) if stub else _by_prompts(collector)
        found = list(presses)
    finally:
        reader.close()
    if not found:
        fail("no press was collected: nothing is written", USAGE)
    try:
        forces = collecting.write(target, found, bundle.pattern)
    except OSError as why:
        fail(f"cannot write {target}: {why.strerror}")
    report = {"presses": len(found), "file": str(target), "forces": None if forces is None else str(forces)}
    if as_json:
        emit(report)
        return
    print(f"wrote {target}: {len(found)} presses; {_next(target, configured.bundle, len(found))}")
    if forces is not None:
        print(f"wrote {forces}; next: skin calibrate force --csv {forces} --measurements {target} --skin {name}")


def _next(target: Path, bundle: str, presses: int) -> str:
    """What may be done with so many presses."""
    from services.calibration.registration import FEWEST

    if presses < FEWEST:
        return f"`skin register` needs at least {FEWEST}: collect more for that"
    return f"next: skin register {target} --skin {bundle} --presses {presses}"


def _on_the_stub(collector: Collector, name: str, bundle: Bundle, n: int, radius: float) -> Iterator[Collected]:
    from services.calibration.collecting import Collected, places
    from services.calibration.force_fit import CalibrationError
    from services.describe import geometry

    failed = 0
    for k, (x, y) in enumerate(places(geometry(bundle)["outline"], n, 1.2 * radius)):
        force = FORCES[k % len(FORCES)]
        press: dict[str, Any] = {"x": float(x), "y": float(y), "force": force, "radius": radius, "seconds": 60.0}
        try:
            before = collector.untouched()
            control("stub", "press", skin=name, **press)
            touched, seen = collector.pressed()
            failed = 0
        except CalibrationError as why:
            where = f"({x * 1e3:+.1f}, {y * 1e3:+.1f}) mm with {force:g} N"
            print(f"  {k + 1}: {where}: {why}; this press does not count", file=sys.stderr)
            failed += 1
            if failed < MOST_FAILED:
                continue
            print(f"  {failed} presses in a row did not count: `skin doctor` says what is in the way", file=sys.stderr)
            return
        finally:
            control("stub", "release", skin=name)
        _say(k, x, y, force, seen.x, seen.y)
        yield Collected(float(x), float(y), force, touched, before)


def _by_prompts(collector: Collector) -> Iterator[Collected]:
    from services.calibration.collecting import Collected
    from services.calibration.force_fit import CalibrationError

    print("type x and y [mm], and newtons if you know them; an empty line ends", file=sys.stderr)
    count = 0
    while True:
        print(f"press {count + 1}, x y [N]? ", end="", file=sys.stderr, flush=True)
        try:
            text = input().strip()
        except EOFError:
            text = ""
        if not text:
            return
        numbers = _numbers(text)
        if numbers is None:
            print(f"found {text!r}, expected two or three numbers, such as: 20 -10 3", file=sys.stderr)
            continue
        x, y, force = numbers
        try:
            before = collector.untouched()
            print("  press there, and hold still", file=sys.stderr)
            touched, seen = collector.pressed()
        except CalibrationError as why:
            print(f"  {why}; this press does not count", file=sys.stderr)
            continue
        _say(count, x, y, force, seen.x, seen.y)
        print("  release", file=sys.stderr)
        count += 1
        yield Collected(x, y, force, touched, before)


def _numbers(text: str) -> tuple[float, float, float | None] | None:
    """x, y [m], force [N] or None; None where the text is not that."""
    try:
        found = [float(word) for word in text.replace(",", " ").split()]
    except ValueError:
        return None
    if len(found) not in (2, 3) or not all(math.isfinite(v) for v in found) or (len(found) == 3 and found[2] <= 0):
        return None
    return found[0] / 1e3, found[1] / 1e3, found[2] if len(found) == 3 else None


def _say(k: int, x: float, y: float, force: float | None, seen_x: float, seen_y: float) -> None:
    pressed = f"({x * 1e3:+.1f}, {y * 1e3:+.1f}) mm" + (f" with {force:g} N" if force is not None else "")
    print(f"  {k + 1}: {pressed}, seen at ({seen_x * 1e3:+.1f}, {seen_y * 1e3:+.1f}) mm", file=sys.stderr, flush=True)
