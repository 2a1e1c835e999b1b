"""Commands that need no running service: reconstruct, register, limits, bench."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated

import typer

from services.cli.common import FAILED, USAGE, JsonOption, emit, fail, interrupted, load_npz

PASS_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


def register(app: typer.Typer) -> None:
    app.command()(reconstruct)
    app.command("register")(register_frame)
    app.command(context_settings=PASS_ON)(limits)
    app.command(context_settings=PASS_ON)(bench)


def reconstruct(
    source: Annotated[Path, typer.Argument(metavar="IN.npz")],
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
    as_json: JsonOption = False,
) -> None:
    """Run the runtime stages over the rows of a file, without sockets.

    IN: measurements (n, k), and untouched (m, k) or reference (n, k). OUT: image (n, 96, 96) float32 conductivity drop
    [S/m], row 0 at the lowest y; touched, valid, count (n,); position (n, 8, 2) [m], force and force_sigma (n, 8) [N],
    strongest first, padded with NaN; shape (n, 8).
    """
    import numpy as np

    from services.recordings.npz_file import InputError, read_scans
    from services.recordings.reconstruction import UNKNOWN_AGE_S, find_skin
    from services.recordings.reconstruction import reconstruct as run

    found, bundle = find_skin(skin)
    try:
        data = read_scans(load_npz(source), bundle)
    except InputError as error:
        fail(f"{source}: {error}", USAGE)
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
        age_s=UNKNOWN_AGE_S if age is None else age,
        calibrate=calibrate,
    )
    try:
        np.savez(target, **out)  # type: ignore[arg-type]
    except OSError as error:
        fail(f"cannot write {target}: {error.strerror}", FAILED)
    result = {"rows": len(out["count"]), "touched": int(out["touched"].sum()), "valid": int(out["valid"].sum())}
    emit(result) if as_json else print("{rows} rows, {touched} touched, {valid} valid".format(**result))


def _bar(rows):  # type: ignore[no-untyped-def]
    from rich.console import Console
    from rich.progress import track

    console = Console(stderr=True)
    return track(rows, "reconstructing", console=console, transient=True, disable=not console.is_terminal)


def register_frame(
    source: Annotated[Path, typer.Argument(metavar="FILE.npz", help="touched, untouched (n, k), xy (n, 2) in metres.")],
    out: Annotated[
        Path | None, typer.Option(help="Folder for the skin's own bundle and a skin.toml; default: calibration/NAME.")
    ] = None,
    skin: Annotated[str, typer.Option("--skin", metavar="NAME", help="A configured skin, or a bundle.")] = "disc16",
    presses: Annotated[int, typer.Option(help="How many presses to use, from the first.")] = 100,
    as_json: JsonOption = False,
) -> None:
    """Fit the skin's frame, and its sensitivities, to presses at places that a machine knows; say how well they fit."""
    from services.calibration.register_command import register_presses

    out = out or Path("calibration", Path(skin).name)
    report = register_presses(load_npz(source), skin, presses, out)
    if as_json:
        emit(report)
        return
    x, y = report["offset_m"]
    seen = "numbered the other way round (seen from behind)" if report["mirrored"] else "numbered as the bundle's"
    print(
        f"the skin lies in the machine's frame at ({x * 1e3:+.1f}, {y * 1e3:+.1f}) mm, turned by "
        f"{report['angle_degrees']:+.1f} degrees, {report['scale']:.3f} times the bundle's size, electrodes {seen}"
    )
    residual = report["residual_m"]
    print(
        f"residual over {presses} presses, each found without itself: median {residual['median'] * 1e3:.1f} mm, "
        f"mean {residual['mean'] * 1e3:.1f} mm"
    )
    print(f"wrote {out}: name it as `bundle` in skin.toml, or run with --config {out / 'skin.toml'}")


def limits(context: typer.Context) -> None:
    """What physics allows: floors of a touch's position, radius and drop. See `skin limits --help`."""
    _dispatch("models.limits", context.args)


def bench(
    context: typer.Context,
    name: Annotated[str, typer.Argument(help="Which one; its own options follow.")] = "",
) -> None:
    """Run a benchmark: `skin bench accuracy --help` shows its options."""
    from bench import commands

    names = commands()
    if name in ("", "--help"):
        print("skin bench NAME [options], NAME one of: " + ", ".join(names))
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
