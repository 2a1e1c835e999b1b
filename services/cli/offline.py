"""Commands that need no running service: reconstruct, register, limits, bench."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from protocol.errors import interrupted
from protocol.whole_file import whole_file
from services.cli.common import FAILED, USAGE, JsonOption, emit, fail
from services.cli.rows import ColumnsOption, PatternOption, UntouchedOption, counts, say_understood, verdicts

PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def register(app: typer.Typer) -> None:
    app.command()(reconstruct)
    app.command("register")(register_frame)
    app.command(context_settings=PASS_ON)(limits)
    app.command(context_settings=PASS_ON)(bench)


def _no_recording(source: Path) -> Path:
    """Refuses one before anything else that is missing on the line is asked for."""
    if source.suffix == ".mcap":
        fail(
            f"found {source}, expected a file of rows: `skin replay {source} --fast --private --out OUT.mcap` "
            "runs the stages over a recording, and `skin export OUT.mcap --csv` makes a table of its contacts",
            USAGE,
        )
    return source


def reconstruct(
    source: Annotated[Path, typer.Argument(metavar="IN", readable=False, is_eager=True, callback=_no_recording)],
    target: Annotated[Path, typer.Argument(metavar="OUT.npz")],
    skin: Annotated[str, typer.Option("--skin", metavar="NAME", help="A configured skin, or a bundle.")],
    sequence: Annotated[
        bool, typer.Option("--sequence", help="Rows are one recording: keep what the stages know.")
    ] = False,
    age: Annotated[
        float | None,
        typer.Option(metavar="SECONDS", min=0, help="From `untouched` to the measurements; not given: minutes."),
    ] = None,
    calibrate: Annotated[
        bool,
        typer.Option(help="First fit how the skin is mounted from `untouched`, where the bundle is off (seconds)."),
    ] = True,
    columns: ColumnsOption = "",
    pattern: PatternOption = "",
    untouched: UntouchedOption = "",
    as_json: JsonOption = False,
) -> None:
    """Run the runtime stages over the rows of a file (npz, npy, mat, csv, each gzipped or not), without sockets.

    IN: measurements (n, k), and untouched (m, k) or reference (n, k); or delta (n, k), touched less untouched in any
    unit. Other forms are read where they can mean one thing only, and the line printed says what was understood. OUT:
    image (n, 96, 96) float32 conductivity drop [S/m], row 0 at the lowest y; touched, valid, count (n,); position
    (n, 8, 2) [m], force and force_sigma (n, 8) [N], strongest first, padded with NaN; shape (n, 8); reasons (n,),
    parted by blanks; check, statistic, limit (n,): what decided; assumed (5, 2): what was taken for known, and what of
    it.
    """
    import numpy as np

    from services.recordings.npz_file import read_file, reading_options
    from services.recordings.reconstruction import find_skin
    from services.recordings.reconstruction import reconstruct as run

    found, bundle = find_skin(skin)
    data = read_file(source, bundle, reading_options(columns, pattern, untouched))
    say_understood(data.understood)
    if target.suffix != ".npz":  # numpy would add it and the file would not be where it was asked for
        fail(f"found {target.name}, expected a name ending in .npz", USAGE)
    if not target.parent.is_dir():
        fail(f"no folder {target.parent} to write {target.name} to: make it first", USAGE)
    out = run(
        data,
        found,
        bundle,
        sequence,
        warn=lambda text: print(f"skin: {text}", file=sys.stderr),
        progress=_bar,
        age_s=age,
        calibrate=calibrate,
    )
    try:
        with whole_file(target) as part:
            np.savez(part, **out)  # type: ignore[arg-type]
    except OSError as error:
        fail(f"cannot write {target}: {error.strerror}", FAILED)
    result = {"rows": len(out["count"]), "touched": int(out["touched"].sum()), "valid": int(out["valid"].sum())}
    if as_json:
        refused, noted = counts(out["reasons"], out["valid"])
        emit(result | {"not_valid": refused, "noted": noted, "assumed": dict(out["assumed"].tolist())})
        return
    print("{rows} rows, {touched} touched, {valid} valid".format(**result))
    for line in verdicts(out["reasons"], out["valid"]):
        print(line)


def _bar(rows):  # type: ignore[no-untyped-def]
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    return track(rows, "reconstructing", console=console, transient=True, disable=not console.is_terminal)


def register_frame(
    source: Annotated[
        Path,
        typer.Argument(
            metavar="FILE.npz",
            readable=False,
            help="touched and untouched, or delta (n, k) in any unit; xy (n, 2) in metres; depth (n,) or force (n,).",
        ),
    ],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the skin's own bundle and a skin.toml; default: calibration/NAME.")
    ] = None,
    skin: Annotated[str, typer.Option("--skin", metavar="NAME", help="A configured skin, or a bundle.")] = "disc16",
    presses: Annotated[
        int | None, typer.Option(min=1, help="How many presses to use, from the first; default: all.")
    ] = None,
    diameter: Annotated[
        float | None, typer.Option(metavar="METRES", min=1e-3, max=10, help="Of the circle through the electrodes.")
    ] = None,
    first_electrode: Annotated[
        float | None,
        typer.Option(metavar="DEGREES", min=-360, max=360, help="Angle of electrode 0 in the machine's frame."),
    ] = None,
    numbering: Annotated[
        str | None, typer.Option(help="clockwise or counter-clockwise, seen in the machine's frame.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Make the bundle of one real skin from presses at places that a machine knows; say how well others are found.

    Ten presses are enough to begin with, a hundred are good, a thousand better. What is known of the skin (--diameter,
    --first-electrode, --numbering) need not be found from them.
    """
    import math

    from services.calibration.register_command import register_presses
    from services.calibration.registration import KnownPose
    from services.recordings.npz_file import load_npz

    if numbering not in (None, "clockwise", "counter-clockwise"):
        fail(f"found --numbering {numbering}, expected clockwise or counter-clockwise", USAGE)
    known = KnownPose(
        diameter,
        None if first_electrode is None else math.radians(first_electrode),
        None if numbering is None else numbering == "clockwise",
    )
    out = out or Path("calibration", Path(skin).name)
    report = register_presses(load_npz(source), skin, presses, out, known)
    if as_json:
        emit(report)
        return
    say_understood(report["understood"])
    x, y = report["offset_m"]
    seen = "numbered the other way round (seen from behind)" if report["mirrored"] else "numbered as the bundle's"
    print(
        f"the skin lies in the machine's frame at ({x * 1e3:+.1f}, {y * 1e3:+.1f}) mm, turned by "
        f"{report['angle_degrees']:+.1f} degrees, {report['scale']:.3f} times the bundle's size, electrodes {seen}"
    )
    print(
        f"known to {report['offset_sigma_m'] * 1e3:.1f} mm, {report['angle_sigma_degrees']:.1f} degrees, "
        f"{100 * report['scale_sigma'] / report['scale']:.0f} % of its size"
    )
    if report["unusable_presses"] or report["unusable_measurements"]:
        print(
            f"left out: {report['unusable_presses']} presses and {report['unusable_measurements']} measurements "
            "that are not finite or never change"
        )
    for doubt in report["doubts"]:
        print(f"in doubt: {doubt}")
    left = report["left_out"]
    print(
        f"{report['presses']} presses, each found without itself: median {left['median_m'] * 1e3:.1f} mm, "
        f"mean {left['mean_m'] * 1e3:.1f} mm, {100 * left['within_90_percent_ellipse']:.0f} % within their 90 % ellipse"
    )
    if "mean_error_of_indentation_m" in left:
        print(f"depth: mean error {left['mean_error_of_indentation_m'] * 1e3:.2f} mm")
    if "mean_error_of_force_n" in left:
        print(f"force: mean error {left['mean_error_of_force_n']:.2f} N")
    print(f"wrote {out}: name it as `bundle` in skin.toml, or run with --config {out / 'skin.toml'}")


def limits(context: typer.Context) -> None:
    """What physics allows: floors of a touch's position, radius and drop. See `skin limits --help`."""
    _dispatch("models.limits", context.args)


def bench(
    context: typer.Context, name: Annotated[str, typer.Argument(help="Which one; its own options follow.")] = ""
) -> None:
    """Run a benchmark: `skin bench accuracy --help` shows its options."""
    from bench import commands

    names = commands()
    if name in ("", "--help"):
        print("skin bench NAME [options], NAME one of: " + ", ".join(names))
        print("--quick is the short form; `skin bench NAME --help` shows the other options.")
        return
    if name not in names:
        fail(f"no benchmark {name!r}: expected one of {', '.join(names)}", USAGE)
    _dispatch(names[name], context.args)


def _dispatch(module: str, args: list[str]) -> None:
    """Hands the rest of the command line to a module's `main`."""
    import importlib

    from models import not_installed

    try:
        status = importlib.import_module(module).main(args)
    except ImportError as error:
        if interrupted(error):
            raise KeyboardInterrupt from None
        said = not_installed(error)
        if not said:
            fail(f"{module} cannot be loaded: {error}")
        fail(f"{module}: {said}", USAGE)
    raise typer.Exit(status or 0)
