"""Commands about the service as a whole: up, doctor."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from services.cli.common import FAILED, USAGE, JsonOption, config_file, emit, fail, of_service

if TYPE_CHECKING:
    from protocol.transport import Transport
    from services.runtime.config import ConfigFile


def register(app: typer.Typer) -> None:
    app.command()(of_service(up, starts=True))
    app.command()(of_service(doctor))
    keys = typer.Typer(help="Key pairs for encrypted TCP sockets.", no_args_is_help=True)
    keys.command("new")(new_keys)
    app.add_typer(keys, name="keys")


def up(
    record: Annotated[Path | None, typer.Option(help="Also record, to this folder.")] = None,
    no_board: Annotated[bool, typer.Option("--no-board", help="Stages only: `skin replay` is the board.")] = False,
) -> None:
    """Start all processes and keep them alive, in the foreground; Ctrl-C or SIGTERM stops them all."""
    from protocol.runtime import lock, runtime_dir
    from services.bridge import check
    from services.runtime import room
    from services.runtime.config import load
    from services.runtime.supervision import programs
    from services.runtime.supervision import up as supervise

    found = load()
    _check_mismatches(found)
    _check_bundles(found)
    for name in found.bridges:
        check(name)
    wanted = [p for p in programs(found, record) if not (no_board and p.name in ("acquisition", "stub"))]
    room.check(len(wanted) + 1, len(found.skins), runtime_dir())
    with lock():  # said before anything else where a service runs here already
        contacts = _addresses(found.transport(), [program.name for program in wanted])
    names, first = ", ".join(found.skins), next(iter(found.skins))
    print(f"skin {names}: contacts at {contacts}, topics contact/{first} ...")
    press = ", press with `./skin press --x 0.02 --y -0.01 --force 3`" * (found.skins[first].port == "stub")
    print(f"look with `./skin top`{press}, stop with Ctrl-C", flush=True)
    raise typer.Exit(supervise(found, wanted=wanted))


def _check_mismatches(config: ConfigFile) -> None:
    """Refuse an unknown mismatch or world before anything starts: the stub would end at once, again and again."""
    for name, skin in config.skins.items():
        if skin.mismatch != "none":
            from models.mismatch import NAMED

            if skin.mismatch not in NAMED:
                fail(
                    f"{config.path}: skins.{name}.mismatch: found {skin.mismatch!r}; allowed: {', '.join(NAMED)}", USAGE
                )
        if skin.world:
            from firmware_stub.worlds.table import WORLDS

            if skin.world not in WORLDS:
                fail(f"{config.path}: skins.{name}.world: found {skin.world!r}; allowed: {', '.join(WORLDS)}", USAGE)


def _check_bundles(config: ConfigFile) -> None:
    """Refuse a bundle, an indenter or a law of forces that cannot be used, likewise. Raises ConfigError."""
    from models.bundle import Bundle, BundleError

    for name, skin in config.skins.items():
        try:
            bundle = Bundle.load(skin.bundle)
        except BundleError as why:
            fail(f"{config.path}: skins.{name}.bundle: {why}", USAGE)
        if (skin.calibration, skin.indenter, skin.reads) != (None, None, None):
            from services.contacts.force.law import ForceLaw

            ForceLaw.of(skin, bundle, name)


def _addresses(transport: Transport, processes: list[str]) -> str:
    """The addresses of the contacts, after a check that all processes can listen at theirs. Raises TransportError."""
    from protocol.transport import check, try_out

    check(transport)
    ours = [name for name in processes if name != "stub"]  # it keeps to the runtime folder, and waits for its place
    data = {name: transport.data_address(name) for name in ours}
    try_out(data | {f"{name}.ctl": transport.control_address(name) for name in ours}, transport)
    return transport.data_address("publisher")


def doctor(as_json: JsonOption = False) -> None:
    """Say what stands in the way of contacts: configuration, bundle, port, board, clock, electrodes."""
    from services.cli.doctor import examine

    findings = examine(config_file())
    if as_json:
        emit([finding.plain() for finding in findings])
    else:
        for finding in findings:
            print(finding)
    if any(finding.level == "FAIL" for finding in findings):
        raise typer.Exit(FAILED)


def new_keys(
    name: Annotated[str, typer.Argument(help="Whose: a process's host, or a controller.")],
    folder: Annotated[Path, typer.Option(help="Where to write the two files.")] = Path("keys"),
) -> None:
    """Make a CURVE key pair. The secret file stays where it is; the other end gets the public one."""
    from protocol.transport import write_keys

    if not name.replace("-", "").replace("_", "").isalnum():
        fail(f"found the name {name!r}, expected letters, digits, - and _", USAGE)
    if (folder / f"{name}.key_secret").exists():
        fail(f"{folder / name}.key_secret is there already: choose another name, or remove it first", USAGE)
    try:
        public, secret = write_keys(folder, name)
    except OSError as error:
        fail(f"cannot write to {folder}: {error.strerror}")
    print(f"secret: {secret} (security.secret_key of this host's skin.toml)")
    print(
        f"public: {public} (to the other end: a service puts it into the folder security.clients or "
        "security.operators, a client names it in security.server_keys)"
    )
