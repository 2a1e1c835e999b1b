"""A bound socket that notices when it is no longer reachable as configured, and opens itself anew.

Its ipc file may be deleted or replaced by another process. A key may be taken from the list; then connections made with
it must end (CURVE looks at keys only at the handshake). A peer may flood it. In each case the socket is closed and
bound again; readers come back by themselves, 30 ms later.
"""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Mapping
from typing import Any

from . import transport
from .gate import described, is_one
from .pause import pause
from .runtime import RuntimeDirError, runtime_dir
from .transport import Context, Socket, TransportError

CHECK_S = 0.5
"""How often at most the socket's file and the folders of keys are looked at."""
SPOKEN_OF_S = 10.0
"""How long status speaks of what was mended."""
LONGEST_RETRY_S = 10.0
"""Of two processes that take one file from each other, both wait longer and longer."""
BIND_S = 0.3
"""How long opening anew waits for the old socket's port to be free."""

log = logging.getLogger(__name__)


class Listening:
    """`socket`, bound at `address`. Call `mind` at least once a second."""

    def __init__(self, context: Context, kind: int, address: str, options: Mapping[int, Any]) -> None:
        self.address = address
        self.admission = transport.admission(address)
        """Whose keys are let in; None where none is asked for."""
        self._context, self._kind, self._options = context, kind, dict(options)
        self._guarded = False
        self.socket: Socket = transport.bind(context, kind, address, options, self.admission)
        self._file = self._inode()
        self._checked = time.monotonic()
        self._trouble, self._until = "", 0.0
        self._unbound = ""
        self._retry_s, self._mended = CHECK_S, 0.0

    @property
    def secured(self) -> bool:
        """Whether peers are known by their keys."""
        return self.admission is not None

    @property
    def problems(self) -> list[str]:
        """What to say in status."""
        found = [self._unbound] if self._unbound else []
        if self._trouble and time.monotonic() < self._until:
            found.append(self._trouble)
        return found + (self.admission.problems if self.admission else [])

    def mind(self) -> bool:
        """Check the socket and mend it where needed; returns whether `socket` is another one now."""
        now = time.monotonic()
        if now - self._checked < (self._retry_s if self._unbound else CHECK_S):
            return False
        self._checked = now
        if trouble := self._unlisted() or self._trouble * bool(self._unbound):
            self.reopen(trouble)
            return True
        trouble = self._robbed()
        if not trouble:
            if now - self._mended > 2 * LONGEST_RETRY_S:
                self._retry_s = CHECK_S
            return False
        if now - self._mended < self._retry_s:
            return False
        if now - self._mended < 2 * LONGEST_RETRY_S:
            self._retry_s = min(2 * self._retry_s, LONGEST_RETRY_S)
        self.reopen(trouble)
        return True

    def _robbed(self) -> str:
        """What happened to the socket's file; "" while it is there."""
        if self._file is None or (found := self._inode()) == self._file:
            return ""
        path = self.address.removeprefix("ipc://")
        if found is None:
            return f"the socket file {path} was deleted; it is there again"
        owner = transport.listener(self.address)
        who = f"process {owner}" if owner else "another process"
        return f"{who} put its own socket at {path}; we took it back: end that process, its readers still read it"

    def _unlisted(self) -> str:
        """A text on connected keys that may no longer connect; "" where there are none."""
        if self.admission is None:
            return ""
        gone = self.admission.let_in - self.admission.keys()
        return f"{len(gone)} key(s) were taken from the list: who held them was disconnected" if gone else ""

    def shed(self, peer: str, what: str) -> None:
        """Disconnect everybody, and let `peer`, who did too much of `what`, in no more for a while."""
        who = described(peer)
        if is_one(peer):
            self._guarded = True
            transport.gate(self._context).refuse(peer)
            self.reopen(f"{who} sent {what}: it was disconnected and is refused for a minute; mend or end it")
        else:
            self.reopen(f"{who} sent {what}: everybody was disconnected to be rid of it; mend or end it")

    def reopen(self, trouble: str) -> None:
        """Close the socket and bind it anew; `trouble` is why."""
        if trouble != self._trouble:
            log.warning("%s: %s", self.address, trouble)
        self._trouble, self._until = trouble, time.monotonic() + SPOKEN_OF_S
        self._mended = time.monotonic()
        self.socket.close(0)
        if self.admission is not None:
            self.admission.let_in.clear()
        deadline = time.monotonic() + BIND_S
        while True:
            try:
                if self.address.startswith("ipc://"):
                    runtime_dir()  # there again, where the whole folder was deleted
                    _remove(self.address)  # it may be another's: a bound file is what `transport.bind` refuses
                self.socket = transport.bind(
                    self._context, self._kind, self.address, self._options, self.admission, guarded=self._guarded
                )
                self._unbound = ""
                break
            except (TransportError, RuntimeDirError) as why:
                if time.monotonic() > deadline:
                    self.socket = self._context.socket(self._kind)  # bound by a later `mind`
                    self.socket.linger = 0
                    self._unbound = str(why)
                    break
                pause(0.002)
        self._file = self._inode()

    def _inode(self) -> tuple[int, int] | None:
        if not self.address.startswith("ipc://"):
            return None
        try:
            found = os.stat(self.address.removeprefix("ipc://"), follow_symlinks=False)
        except OSError:
            return None
        return (found.st_dev, found.st_ino)

    def close(self, linger_ms: int | None = 0) -> None:
        """Close the socket."""
        self.socket.close(linger_ms)


def _remove(address: str) -> None:
    try:
        os.unlink(address.removeprefix("ipc://"))
    except OSError:
        pass
