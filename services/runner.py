"""The one runner of all processes: sockets, freshness, stamps, counters, heartbeats, commands, signals.

It drives one stage object for each skin. Nothing that arrives on a socket ends it.
"""

from __future__ import annotations

import gc
import logging
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from itertools import cycle
from typing import Any

import zmq

from models.bundle import Bundle
from protocol import transport
from protocol.frames import Frame, FrameError, InfoFrame
from protocol.publishing import covers
from protocol.runtime import host_id
from protocol.sockets import ControlError, ControlServer, Publisher
from protocol.topics import TOPIC_OF
from services import persistence
from services.config import Config
from services.lane import Feed, Lane, Newest
from services.lateness import Lateness
from services.stage import Refused, Stage, add_reason
from services.waiting import Waiter

HEARTBEAT_S = 1.0
TICK_S = 0.2  # how often at most silence, changes of health and new subscribers are looked for
SILENT_S = 0.5  # without frames from upstream: status STALE
AT_ONCE = 256  # frames taken from a feed before any is processed
WARM_FRAMES = 50  # frames after which what lives is taken to live for ever (garbage collection)

log = logging.getLogger(__name__)


class Runner:
    """A process: its sockets and its lanes. `run` returns when SIGINT or SIGTERM came."""

    def __init__(self, process: str, config: Config, problems: Sequence[str] = ()) -> None:
        """problems: what the process as a whole goes without, for its status."""
        self.process, self.config, self.problems = process, config, list(problems)
        for problem in problems:
            log.warning("%s", problem)
        transport.configure(config.transport())
        self.publisher = Publisher(process)
        commands = {"status": self._status, "state": self._state, "load": self._load, "reset": self._reset}
        self.control = ControlServer(process, commands)
        self.lanes: dict[str, Lane] = {}
        self._bundles: dict[str, Bundle] = {}
        self._waiter = Waiter()
        self._lateness = Lateness()
        self.publisher.on_join = self._joined
        self._minded: list[tuple[Publisher | ControlServer, Any]] = []  # what listens, with the socket we wait for
        self._by_socket: dict[Any, Lane] = {}
        self._stop = False
        self._frames = 0
        self._turns: Iterator[Lane] = iter(())  # who may prepare next
        self._settled = False  # what was made while warming up is out of the garbage collector's sight

    def bundle(self, skin: str) -> Bundle:
        """The bundle of a skin, loaded once."""
        name = self.config.skins[skin].bundle
        if name not in self._bundles:
            self._bundles[name] = Bundle.load(name)
        return self._bundles[name]

    def add(self, stage: Stage, feed: Feed | None = None) -> None:
        """Drive this stage; without a feed, from the topic that it reads."""
        lane = Lane(self.process, stage, Newest(stage.reads, stage.skin) if feed is None else feed)
        self.lanes[stage.skin] = lane
        self._by_socket[lane.feed.socket] = lane
        for command in stage.commands:
            self.control.handlers[command] = self._commander(command)
        if stage.persists:
            self._restore(lane)
        stage.warm_up()

    def run(self) -> None:
        """Drive the lanes until told to stop."""
        wake = _wake_on_signals(self._on_signal)
        for socket in (wake, self.control.socket, self.publisher.socket, *self._by_socket):
            self._waiter.register(socket)
        self._minded = [(self.publisher, self.publisher.socket), (self.control, self.control.socket)]
        self._turns = cycle(self.lanes.values())
        _settle()
        next_tick = deadline = 0.0
        while not self._stop:
            timeout_s = max(next_tick, deadline) - time.monotonic()
            ready = self._waiter.wait(timeout_s)
            stood = self._lateness.stood_still(timeout_s)
            self._serve([self._by_socket[socket] for socket in ready if socket in self._by_socket], stood)
            for socket in ready:
                if socket is self.control.socket:
                    self.control.serve_once()
                elif socket is self.publisher.socket:
                    self.publisher.poll()
                    next_tick = 0.0
            if time.monotonic() >= next_tick:
                self._tick()
                self._waiter.doubt()
                next_tick, deadline = time.monotonic() + TICK_S, self._next_deadline()
            if ready and not self._waiter.wait(0.0):
                self._prepare()
        self.close()

    def _next_deadline(self) -> float:
        """When there is something to do if nothing arrives: a heartbeat, or silence to be noticed."""
        return min((lane.heartbeat.deadline(SILENT_S) for lane in self.lanes.values()), default=0.0)

    def close(self) -> None:
        for lane in self.lanes.values():
            lane.feed.close()
        self._lateness.close()
        self.control.close()
        self.publisher.close()
        self._waiter.close()

    # frames

    def _serve(self, lanes: list[Lane], stood: bool = False) -> None:
        """What waits at these lanes, newest frames of several skins together."""
        work = [(lane, frame) for lane in lanes for frame in self._waiting(lane, stood)]
        if len(work) > 1 and self.config.skip.batch:
            try:
                type(work[0][0].stage).together([(lane.stage, frame) for lane, frame in work])
            except Exception as why:  # each frame is still processed by itself
                log.exception("%d frames could not be processed together", len(work), exc_info=why)
        for lane, frame in work:
            self._handle(lane, frame)

    def _waiting(self, lane: Lane, stood: bool) -> list[Frame]:
        """Frames to process: the newest of a socket, all of a feed but what it is too late for."""
        frames: list[Frame] = []
        while len(frames) < AT_ONCE and (frame := lane.feed.recv()) is not None:
            frames.append(frame)
            if isinstance(lane.feed, Newest):
                return frames
        news = self._lateness.news(frames, stood)
        lane.heartbeat.drops["late"] += len(frames) - len(news)
        return news

    def _handle(self, lane: Lane, frame: Frame) -> None:
        beat, stage = lane.heartbeat, lane.stage
        now = time.monotonic_ns()
        beat.heard(frame, now)
        try:
            made = stage.process(frame, lane.wanted)
        except Exception as why:
            self._failed(lane, why)
            return
        done = time.monotonic_ns()
        late = False
        for n, out in enumerate(made):
            if out.host in ("", host_id()):  # whose clock the stamps are of
                out.stamps.setdefault(stage.stamp, done)
            if n == 0:
                late = self._lateness.late(out)
            if late:
                out.valid = False
                add_reason(out.reasons, "late")
            self._send(lane, out)
        beat.done(frame, now, time.monotonic_ns(), late)
        if stage.lacks and not lane.asleep and isinstance(lane.feed, Newest):
            lane.feed.ask_again()
        self._frames += 1

    def _joined(self, prefix: bytes) -> None:
        """Somebody subscribes to what begins so."""
        for lane in self.lanes.values():
            for topic, head in lane.heads.items():
                if covers(prefix, head):
                    lane.stage.joined(topic)

    def _prepare(self) -> None:
        """One piece of work for later, while nobody waits: the lanes take turns, for even asking all of them costs."""
        if self._frames >= WARM_FRAMES and not self._settled:
            self._settled = True
            _settle()
        else:
            lane = next(self._turns)
            try:
                lane.stage.prepare()
            except Exception as why:  # what could not be made ahead is made when it is needed, or fails then
                self._log_once(lane, why, "%s: could not prepare (further such failures are not logged)")

    def _send(self, lane: Lane, frame: Frame) -> None:
        try:
            self.publisher.send(frame)
            lane.heartbeat.sent[TOPIC_OF[type(frame)].name] += 1
        except (FrameError, zmq.ZMQError) as why:
            self._failed(lane, why)

    def _wanted(self, stage: Stage) -> frozenset[str]:
        """Topics that the stage is to make: those somebody subscribes to, unless skin.toml says all."""
        if not self.config.skip.unwanted:
            return frozenset(stage.writes)
        return frozenset(topic for topic in stage.writes if self.publisher.wanted(topic, stage.skin))

    def _failed(self, lane: Lane, why: Exception) -> None:
        lane.heartbeat.drops["failed"] += 1
        lane.heartbeat.failure = f"a frame could not be processed: {type(why).__name__}: {why}"
        self._log_once(lane, why, "%s: a frame was dropped (further ones of this kind are only counted)")

    @staticmethod
    def _log_once(lane: Lane, why: Exception, text: str) -> None:
        if str(why) not in lane.errors and len(lane.errors) < 100:
            lane.errors.add(str(why))
            log.exception(text, lane.stage.skin, exc_info=why)

    # housekeeping

    def _mind_sockets(self) -> list[str]:
        """Mend what has become of our sockets; what to say of it in status."""
        for place, (owner, socket) in enumerate(self._minded):
            if owner.mind():
                self._waiter.exchange(socket, owner.socket)
                self._minded[place] = (owner, owner.socket)
        return self.publisher.problems + self.control.problems

    def _tick(self) -> None:
        self.publisher.poll()
        problems = self.problems + self._mind_sockets()
        now = time.monotonic()
        for lane in self.lanes.values():
            lane.wanted = self._wanted(lane.stage)
            self._sleep_or_wake(lane)
            if isinstance(lane.feed, Newest):
                lane.feed.mind()
            beat = lane.heartbeat
            beat.drops["malformed"], beat.drops["skipped"] = lane.feed.malformed, lane.feed.skipped
            silent = "" if lane.asleep else beat.silence(SILENT_S, lane.stage.reads)
            health = lane.stage.health().with_problems(problems)
            status = beat.status(health, silent, now, HEARTBEAT_S, asleep=lane.asleep)
            if status is not None:
                self._send(lane, status)
            info = lane.stage.info()
            if info is not None:
                age = (
                    {"tare_age_s": (time.monotonic_ns() - info["tare_sample_ns"]) * 1e-9}
                    if info.get("tare_sample_ns")
                    else {}
                )
                self._send(lane, InfoFrame(skin=lane.stage.skin, process=self.process, valid=True, info=info | age))
            if lane.stage.persists and (saved := lane.stage.saved()) is not None:
                persistence.save(self.process, lane.stage.skin, saved)

    def _sleep_or_wake(self, lane: Lane) -> None:
        """A stage whose frames nobody reads does not read either, so that upstream need not work for it."""
        if not lane.stage.sleeps or not isinstance(lane.feed, Newest):
            return
        idle = not lane.wanted
        if idle != lane.asleep:
            lane.asleep = idle
            lane.feed.listen(not idle)
            if not idle:
                lane.stage.wake()

    def _restore(self, lane: Lane) -> None:
        found = persistence.restore(self.process, lane.stage.skin)
        if found is None:
            return
        try:
            lane.stage.restore(*found)
            log.info("%s: took over the baseline of %.0f s ago", lane.stage.skin, found[1])
        except Refused as why:
            log.warning("%s: %s", lane.stage.skin, why)

    def _on_signal(self) -> None:
        self._stop = True

    # commands

    def _lane(self, args: dict[str, Any]) -> Lane:
        name = args.get("skin") or next(iter(self.lanes))
        if not isinstance(name, str) or name not in self.lanes:
            raise ControlError("bad_request", f"no skin called {name!r}; configured: {', '.join(self.lanes)}")
        return self.lanes[name]

    def _commander(self, command: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
        def carry_out(args: dict[str, Any]) -> dict[str, Any]:
            lane = self._lane(args)
            try:
                result: dict[str, Any] = persistence.plain(lane.stage.command(command, args))
                return result
            except Refused as why:
                raise ControlError("refused", str(why)) from None

        return carry_out

    def _status(self, args: dict[str, Any]) -> dict[str, Any]:
        """`flowing`: whether a frame came within SILENT_S (or nobody wants one); what status/<skin> said last."""
        lane = self._lane(args)
        return lane.heartbeat.summary(asleep=lane.asleep, silent_s=SILENT_S)

    def _state(self, args: dict[str, Any]) -> dict[str, Any]:
        """The stage's temporal state, for a recording."""
        return {"state": persistence.plain(self._lane(args).stage.state())}

    def _load(self, args: dict[str, Any]) -> dict[str, Any]:
        """Take over a state that `state` gave."""
        if not isinstance(args.get("state"), dict):
            raise ControlError("bad_request", "load needs `state`, a map as the command state gives it")
        stage = self._lane(args).stage
        try:
            stage.load(persistence.arrays(args["state"]))
        except Exception as why:  # whatever was in the state, the stage goes on, with none
            stage.reset()
            what = str(why) if isinstance(why, Refused) else f"{type(why).__name__}: {why}"
            raise ControlError("refused", f"the state does not fit: {what}") from None
        return {}

    def _reset(self, args: dict[str, Any]) -> dict[str, Any]:
        """Forget all temporal state; with `new_session` also begin a session, whose frames count from 0."""
        stage = self._lane(args).stage
        stage.reset()
        if args.get("new_session"):
            stage.new_session()
            self.publisher.renew()
        return {"session": self.publisher.session}


def _settle() -> None:
    """What lives now is taken to live for ever: the garbage collector never walks it again, and seldom the rest. The
    first call takes some ten milliseconds, a later one a fraction.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 50, 50)


def _wake_on_signals(stop: Callable[[], None]) -> int:
    """Install handlers of SIGINT and SIGTERM; the returned descriptor becomes readable when one came."""
    read, write = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)
    signal.set_wakeup_fd(write, warn_on_full_buffer=False)
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda *_: stop())
    return read
