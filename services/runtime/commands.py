"""The commands of a process. This module carries out those of every process; a stage carries out its own."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

from protocol.control import ControlError
from protocol.publishing import Publisher
from services.runtime import persistence
from services.runtime.channel import Channel
from services.runtime.stage import Refused

Handler = Callable[[dict[str, Any]], dict[str, Any]]


class Commands:
    """A command names its skin; without a name it is for the first one."""

    def __init__(self, channels: Mapping[str, Channel], publisher: Publisher, silent_s: float) -> None:
        """silent_s: without frames for so long, nothing flows."""
        self.channels, self.publisher, self.silent_s = channels, publisher, silent_s

    def handlers(self) -> dict[str, Handler]:
        """The commands that every process knows."""
        return {"status": self._status, "state": self._state, "load": self._load, "reset": self._reset}

    def of_the_stage(self, command: str) -> Handler:
        """A command that the stage carries out itself."""

        def carry_out(args: dict[str, Any]) -> dict[str, Any]:
            channel = self._channel(args)
            try:
                result: dict[str, Any] = persistence.plain(channel.stage.command(command, args))
                return result
            except Refused as why:
                raise ControlError("refused", str(why)) from None

        return carry_out

    def _channel(self, args: dict[str, Any]) -> Channel:
        name = args.get("skin") or next(iter(self.channels))
        if name not in self.channels:
            raise ControlError("bad_request", f"no skin called {name!r}; configured: {', '.join(self.channels)}")
        return self.channels[name]

    def _status(self, args: dict[str, Any]) -> dict[str, Any]:
        """`flowing`: whether a frame came within `silent_s` (or nobody wants one); what status/<skin> said last."""
        channel = self._channel(args)
        return channel.heartbeat.summary(asleep=channel.asleep, silent_s=self.silent_s)

    def _state(self, args: dict[str, Any]) -> dict[str, Any]:
        """The stage's temporal state, for a recording."""
        return {"state": persistence.plain(self._channel(args).stage.state())}

    def _load(self, args: dict[str, Any]) -> dict[str, Any]:
        """Take over a state that `state` gave."""
        stage = self._channel(args).stage
        try:
            stage.load(persistence.arrays(args["state"]))
        except Exception as why:  # whatever was in the state, the stage goes on, with none
            stage.reset()
            what = str(why) if isinstance(why, Refused) else f"{type(why).__name__}: {why}"
            raise ControlError("refused", f"the state does not fit: {what}") from None
        return {}

    def _reset(self, args: dict[str, Any]) -> dict[str, Any]:
        """Forget all temporal state; with `new_session` also begin a session, whose frames count from 0."""
        stage = self._channel(args).stage
        stage.reset()
        if args.get("new_session"):
            stage.new_session()
            self.publisher.renew()
        return {"session": self.publisher.session}
