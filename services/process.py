"""What every process of the service does first and last."""

from __future__ import annotations

import contextlib
import logging
import sys
from collections.abc import Callable

from models.bundle import Bundle, BundleError
from protocol import logs
from protocol.runtime import AlreadyRunning, RuntimeDirError, lock
from protocol.transport import TransportError
from services.runner import Runner
from services.runtime import realtime, room
from services.runtime.config import ConfigError, Skin, load
from services.runtime.stage import Stage


def main(process: str, setup: Callable[[Runner], None]) -> int:
    """A process's main: configuration, sockets, channels, loop. Returns the exit status; says on stderr what stands in
    the way.
    """
    logs.setup(f"{process}: %(message)s")
    try:
        config = load()
        logging.getLogger().setLevel(config.logging.level.upper())
        refused = realtime.apply(config.realtime, process)
        with lock(process=process):  # whose sockets these are, for as long as we live
            runner = Runner(process, config, refused)
            setup(runner)
            with contextlib.suppress(KeyboardInterrupt):
                runner.run()
    except (AlreadyRunning, ConfigError, BundleError, RuntimeDirError, TransportError) as why:
        print(f"{process}: {why}", file=sys.stderr)
        return 1
    except Exception as why:
        if not (lacking := room.sentence(why)):
            raise
        print(f"{process}: {lacking}", file=sys.stderr)
        return 1
    return 0


def stages(make: Callable[[str, Skin, Bundle], Stage]) -> Callable[[Runner], None]:
    """Set-up of a process that runs one kind of stage for every configured skin."""

    def setup(runner: Runner) -> None:
        for name, skin in runner.config.skins.items():
            runner.add(make(name, skin, runner.bundle(name)))

    return setup
