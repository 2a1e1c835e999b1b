"""`skin calibrate force`: a skin's own force law from a handful of presses of known force."""

from __future__ import annotations

import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
import typer.core

from services.cli import calibrate_live
from services.cli.common import (
    USAGE,
    JsonOption,
    SkinOption,
    config_file,
    emit,
    fail,
    of_service,
    skin_name,
    use_configured_sockets,
)

if TYPE_CHECKING:
    from models.bundle import Bundle
    from services.calibration.force_fit import Press
    from services.calibration.seen import TouchReader
    from services.runtime.config import Skin

PLAN = ((0, 0, 1), (0, 0, 3), (0, 0, 5), (1, 1, 2), (-1, 1, 4), (-1, -1, 2), (1, -1, 4))
"""Where to press (halves of the way to the edge), and about how firmly [N]; then again from the first, another tip."""
MOST_TIP_MM = 1000.0  # as --tip: what is larger was no radius in millimetres


class ForceUnlessNamed(typer.core.TyperGroup):
    """`skin calibrate --live` is `skin calibrate force --live`."""

    def parse_args(self, context: Any, args: list[str]) -> list[str]:
        named = not args or not args[0].startswith("-") or args[0] == "--help"
        return super().parse_args(context, args if named else ["force", *args])


def register(app: typer.Typer) -> None:
    calibrate = typer.Typer(cls=ForceUnlessNamed, help="Teach a skin from what is known.", no_args_is_help=True)
    calibrate.callback()(lambda: None)  # so that `force` stays a command of its own
    calibrate.command("force")(of_service(force))
    app.add_typer(calibrate, name="calibrate")


def force(
    skin: SkinOption = "",
    live: Annotated[
        bool, typer.Option("--live", help="Another sensor says each force, over the topic reference/SKIN.")
    ] = False,
    csv: Annotated[
        Path | None, typer.Option(readable=False, help="Presses from a file instead of by prompts; see below.")
    ] = None,
    measurements: Annotated[
        Path | None, typer.Option(readable=False, help="With --csv: FILE.npz whose rows its column `row` names.")
    ] = None,
    save: Annotated[Path | None, typer.Option(help="Also keep the presses, as a CSV that --csv reads.")] = None,
    out: Annotated[Path | None, typer.Option(help="The calibration; default: calibration/SKIN-force.json.")] = None,
    tip: Annotated[
        float, typer.Option(min=0, max=1, metavar="METRES", help="With --live: radius of what presses; 0: not known.")
    ] = 0.0,
    presses: Annotated[
        int, typer.Option(min=1, metavar="N", help="With --live: end after so many, enough or not.")
    ] = 60,
    most: Annotated[
        float, typer.Option(min=0, help="Newtons beyond which it is extrapolated; default: the firmest.")
    ] = 0.0,
    as_json: JsonOption = False,
) -> None:
    """Fit the skin's force law to presses of known force and say how well it predicts each press from the others.

    By prompts: type the force, press and hold still, release; an empty line ends. With --live nothing is typed: press
    until it is enough; Ctrl-C ends before. CSV: a line of names, then a press a line:
    force_n,x_m,y_m,pressure_n,peak_s_per_m,integral_s_m as --save writes it; or, with --measurements: force_n,row (from
    0). With --live its presses count beside the new ones. tip_m, the radius of what pressed, may stand beside
    either: two sizes tell whether force follows pressure, peak or integral.
    """
    from models.bundle import Bundle
    from services.calibration import presses_csv as calibration_csv
    from services.calibration.force_fit import CalibrationError, fit, unknown
    from services.calibration.seen import TouchReader
    from services.contacts.force import calibration_file as calibration
    from services.runtime.config import load

    name = skin_name(skin)
    configured = load(config_file()).skin(name)
    bundle = Bundle.load(configured.bundle)
    indenter_m, any_tip = calibration.indenter_radius(configured), configured.indenter is None
    if measurements is not None and csv is None:
        fail(
            "--measurements needs --csv FILE with columns force_n,row: which row was measured under which force", USAGE
        )
    if not live and tip:
        fail("--tip needs --live: by prompts it is asked for, in a CSV it is the column tip_m", USAGE)
    made = [] if csv is None else _from_csv(csv, measurements, configured, bundle)
    if live:
        made += calibrate_live.pressed(name, TouchReader(configured, bundle), made, tip, presses, any_tip)
    elif csv is None:
        made = _prompted(name, bundle, TouchReader(configured, bundle))
    out = out or Path("calibration", f"{name}-force.json")
    try:
        if save is not None:
            save.parent.mkdir(parents=True, exist_ok=True)
            calibration_csv.write(save, made, indenter_m)
        found = fit(made, most or None, any_tip)
        out.parent.mkdir(parents=True, exist_ok=True)
        digest = calibration.save(out, found, name, configured, bundle)
    except OSError as why:
        fail(f"cannot write {why.filename}: {why.strerror}")
    except CalibrationError:
        if save is not None:
            print(f"skin: the presses are kept in {save}", file=sys.stderr)
        raise
    report = {
        "file": str(out),
        "sha256": digest,
        "of": found.reads,
        "tip_m": found.tip_m,
        "most_n": found.most_n,
        **found.origin,
    }
    report |= {"curve": found.curve.to_dict(), "unknown": unknown(found, configured)}
    emit(report) if as_json else _say(report)


def _say(report: dict[str, Any]) -> None:
    from services.contacts.force.law import NAMES

    curve, error, of = report["curve"], report["error"], NAMES[report["of"]]
    place = "" if curve["correction"] == "none" else f", corrected for the place ({curve['correction']})"
    if report["tip_m"] is not None:
        print(f"all presses are as under one tip of {1e3 * report['tip_m']:.1f} mm radius: forces are of such a tip")
    print(f"force = {curve['scale']:.4g} * ({of})^{curve['exponent']:.3f}{place}, to {report['most_n']:g} N")
    print(
        f"each of the {report['presses']} presses foretold by the others: off by "
        f"{100 * error['left_out_median']:.1f} % (median), {100 * error['left_out_rms']:.1f} % (root mean square); "
        f"the law itself is known to {100 * error['law']:.1f} %"
    )
    if report["unknown"]:
        print(report["unknown"])
    print(
        f"wrote {report['file']} ({report['sha256'][:12]}): name it as `calibration` in skin.toml, restart the service"
    )


def _from_csv(csv: Path, measurements: Path | None, skin: Skin, bundle: Bundle) -> list[Press]:
    from services.calibration import presses_csv
    from services.calibration.force_presses import of_file
    from services.contacts.force.calibration_file import indenter_radius

    if measurements is None:
        return presses_csv.read(csv, indenter_radius(skin))
    return presses_csv.read(
        csv, None, of_file(measurements, skin, bundle, lambda text: print(f"skin: {text}", file=sys.stderr))
    )


def _prompted(name: str, bundle: Bundle, read: TouchReader) -> list[Press]:
    """Presses on the live service, one prompt each."""
    from protocol.sockets import AllReader
    from services.calibration.force_fit import CalibrationError, Press
    from services.calibration.force_presses import wait_for_press, wait_for_release

    use_configured_sockets()
    quarter = 0.25e3 * bundle.image_size * bundle.metres_per_pixel  # mm, half the way to the edge
    presses: list[Press] = []
    tip: float | None = None
    print("type the force in newtons, then press and hold still until told; an empty line ends", file=sys.stderr)
    while True:
        if len(presses) % len(PLAN) == 0:
            tip = _tip(len(presses) // len(PLAN))
        x, y, about = PLAN[len(presses) % len(PLAN)]
        hint = f"press {len(presses) + 1}, say at ({x * quarter:+.0f}, {y * quarter:+.0f}) mm with about {about} N"
        try:
            print(f"{hint}: newtons? ", end="", file=sys.stderr, flush=True)
            text = input().strip()
        except EOFError:
            text = ""
        if not text:
            return presses
        try:
            newton = float(text)
        except ValueError:
            print(f"found {text!r}, expected a number of newtons", file=sys.stderr)
            continue
        reader = AllReader(["image"], name)  # a new one each time: nothing of before the prompt is in it
        try:
            seen = wait_for_press(reader, read)
            print(f"  {newton:g} N at ({seen.x * 1e3:+.1f}, {seen.y * 1e3:+.1f}) mm: release", file=sys.stderr)
            presses.append(Press(newton, seen, f"press {len(presses) + 1}", tip))
            wait_for_release(reader)
        except CalibrationError as why:
            print(f"  {why}; this press does not count", file=sys.stderr)
        finally:
            reader.close()


def _tip(number: int) -> float | None:
    """Radius [m] of the tip that the next presses are made with; None where it is not said."""
    which = "the tip" if number == 0 else "another tip, of half or twice the size if there is one"
    while True:
        print(f"radius of {which} in millimetres (empty: not known)? ", end="", file=sys.stderr, flush=True)
        try:
            text = input().strip()
        except EOFError:
            return None
        if not text:
            return None
        try:
            found = float(text)
        except ValueError:
            found = math.nan
        if 0 < found <= MOST_TIP_MM:
            return found * 1e-3
        print(f"found {text!r}, expected millimetres above 0, {MOST_TIP_MM:g} at most, or nothing", file=sys.stderr)
