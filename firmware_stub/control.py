"""The stub's control socket: press, release, scene, faults, status. In a thread of its own: a press costs a solve."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable
from typing import Any

import zmq

from protocol.sockets import ControlServer

from . import scene as scenes
from .faults import FAULTS
from .rig import Rig

log = logging.getLogger(__name__)


class Control:
    """Serves the rig's commands until `close`. `clock` gives the rig's time in seconds."""

    def __init__(self, rig: Rig, skin: str, clock: Callable[[], float], context: zmq.Context[Any]) -> None:
        self._rig, self._skin, self._clock, self._context = rig, skin, clock, context
        self._stop = threading.Event()
        self._server = self._bind()
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)
        self._thread.start()

    def _bind(self) -> ControlServer:
        handlers = {
            "press": lambda args: self._rig.press(self._mine(args), self._clock()),
            "release": lambda args: self._rig.release(self._clock()),
            "scene": self._scene,
            "faults": self._fault,
            "fault": self._fault,
            "status": lambda args: self._rig.status(self._clock()),
        }
        return ControlServer("stub", handlers, context=self._context)

    def _mine(self, args: dict[str, Any]) -> dict[str, Any]:
        """The arguments, unless they are meant for another skin."""
        skin = args.pop("skin", None) or self._skin
        if skin != self._skin:
            raise ValueError(f"this stub is skin {self._skin!r}, not {skin!r}")
        for key in ("x", "y"):
            if key not in args:
                raise ValueError(f"press needs {key}, in metres")
        if args.get("force") is None and args.get("drop") is None:
            raise ValueError("press needs force (N) or drop (S/m)")
        return args

    def _scene(self, args: dict[str, Any]) -> dict[str, Any]:
        if not args.get("name"):
            return {"scenes": {name: scenes.load(name).about for name in scenes.names()}}
        return self._rig.play(str(args["name"]), self._clock())

    def _fault(self, args: dict[str, Any]) -> dict[str, Any]:
        now, name = self._clock(), args.get("name")
        if args.get("clear"):
            self._rig.faults.clear(*([str(name)] if name else []))
            return {"faults": self._rig.faults.listing(now)}
        if not name:
            known = {key: {"what": row.what, "args": dict(row.args)} for key, row in FAULTS.items()}
            return {"known": known, "faults": self._rig.faults.listing(now)}
        return self._rig.fault(str(name), args.get("args") or {}, now, float(args.get("seconds", 5.0)))

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
