"""The stub's control socket: press, release, scene, faults, status. In a thread of its own: a press costs a solve."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping
from typing import Any

import zmq

from protocol.sockets import ControlServer

from . import scene as scenes
from .faults import FAULTS
from .rig import Rig

log = logging.getLogger(__name__)
SOON_S = 0.5  # a scene that was solved before begins so long after its answer was made, on time


class Control:
    """Serves the commands of all rigs (by skin) until `close`. `clock` gives their time in seconds; begin_ns: this
    host's monotonic clock when that was zero.
    """

    def __init__(
        self, rigs: Mapping[str, Rig], clock: Callable[[], float], context: zmq.Context[Any], begin_ns: int = 0
    ) -> None:
        self._rigs, self._clock, self._context, self._begin_ns = rigs, clock, context, begin_ns
        self._stop = threading.Event()
        self._server = self._bind()
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)
        self._thread.start()

    def _bind(self) -> ControlServer:
        handlers = {
            "press": lambda args: self._rig(args).press(args, self._clock()),
            "release": lambda args: self._rig(args).release(self._clock(), args.get("finger", "")),
            "scene": self._scene,
            "faults": self._fault,
            "fault": self._fault,
            "status": lambda args: self._rig(args).status(self._clock()),
        }
        return ControlServer("stub", handlers, context=self._context)

    def _rig(self, args: dict[str, Any]) -> Rig:
        """The rig of the skin meant, by default the first."""
        name = args.get("skin") or next(iter(self._rigs))
        if name not in self._rigs:
            raise ValueError(f"the stub board has no skin {name!r}: expected one of {', '.join(self._rigs)}")
        return self._rigs[name]

    def _scene(self, args: dict[str, Any]) -> dict[str, Any]:
        if not args.get("name"):
            return {"scenes": {name: scenes.load(name).about for name in scenes.names()}}
        rig, name = self._rig(args), args["name"]
        solved = rig.solve(name) if args.get("solved") else None
        now, wait_s = self._clock(), SOON_S if solved else 0.0
        played = rig.play(name, now, wait_s)
        return played | {"start_ns": self._begin_ns + round((now + wait_s) * 1e9), "poses": solved}

    def _fault(self, args: dict[str, Any]) -> dict[str, Any]:
        rig, now, name = self._rig(args), self._clock(), args.get("name")
        if args.get("clear"):
            rig.faults.clear(*([name] if name else []))
            return {"faults": rig.faults.listing(now)}
        if not name:
            known = {
                key: {"what": row.what, "args": dict(row.args), "sticky": row.sticky} for key, row in FAULTS.items()
            }
            return {"known": known, "faults": rig.faults.listing(now)}
        return rig.fault(name, args.get("args", {}), now, args.get("seconds", 5.0))

    def _serve(self) -> None:
        try:
            while not self._stop.is_set():
                self._server.serve_once(0.1)
                self._server.mind()
        except zmq.ContextTerminated:
            pass
        finally:
            self._server.close()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(2.0)
