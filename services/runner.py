"""The one runner of all processes: sockets, freshness, stamps, counters, heartbeats, commands, signals.

It drives one stage object for each skin. Nothing that arrives on a socket ends it.
"""

from __future__ import annotations

import gc
import logging
import time
from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import Any

import zmq

from models.bundle import Bundle
from protocol import transport
from protocol.frames import Frame, FrameError, InfoFrame
from protocol.publishing import covers
from protocol.runtime import host_id
from protocol.sockets import ControlServer, Publisher, StageReader
from protocol.topics import TOPIC_OF
from services.runtime import persistence
from services.runtime.channel import Channel, Feed
from services.runtime.commands import Commands
from services.runtime.config import ConfigFile
from services.runtime.lateness import Lateness
from services.runtime.stage import Refused, Stage, invalidate
from services.runtime.waiting import Waiter, wake_on_signals

HEARTBEAT_S = 1.0
TICK_S = 0.2  # how often at most silence, changes of health and new subscribers are looked for
SILENT_S = 0.5  # without frames from upstream: status STALE
AT_ONCE = 256  # frames taken from a feed before any is processed
WARM_FRAMES = 50  # frames after which the living objects are taken to be permanent (garbage collection)

log = logging.getLogger(__name__)


class Runner:
    """A process: its sockets and its channels. `run` returns when SIGINT or SIGTERM came."""

    def __init__(self, process: str, config: ConfigFile, problems: Sequence[str] = ()) -> None:
        """problems: what the process as a whole lacks, for its status."""
        self.process, self.config, self.problems = process, config, list(problems)
        for problem in problems:
            log.warning("%s", problem)
        transport.configure(config.transport())
        self.publisher = Publisher(process)
        self.channels: dict[str, Channel] = {}
        self._commands = Commands(self.channels, self.publisher, SILENT_S)
        self.control = ControlServer(process, self._commands.handlers())
        self._bundles: dict[str, Bundle] = {}
        self._waiter = Waiter()
        self._lateness = Lateness()
        self.publisher.on_join = self._joined
        self._minded: list[tuple[Publisher | ControlServer, Any]] = []  # what listens, with the socket we wait for
        self._by_socket: dict[Any, Channel] = {}
        self._stop = False
        self._frames = 0
        self._turns: Iterator[Channel] = iter(())  # who may prepare next
        self._settled = False  # the garbage collector no longer walks what was made while warming up

    def bundle(self, skin: str) -> Bundle:
        """The bundle of a skin, loaded once."""
        name = self.config.skins[skin].bundle
        if name not in self._bundles:
            self._bundles[name] = Bundle.load(name)
        return self._bundles[name]

    def add(self, stage: Stage, feed: Feed | None = None) -> None:
        """Drive this stage; without a feed, from the topic that it reads."""
        channel = Channel(self.process, stage, StageReader(stage.reads, stage.skin) if feed is None else feed)
        self.channels[stage.skin] = channel
        self._by_socket[channel.feed.socket] = channel
        self.control.add({command: self._commands.of_the_stage(command) for command in stage.commands})
        if stage.persists:
            self._restore(channel)
        stage.warm_up()

    def run(self) -> None:
        """Drive the channels until told to stop."""
        wake = wake_on_signals(self._on_signal)
        for socket in (wake, self.control.socket, self.publisher.socket, *self._by_socket):
            self._waiter.register(socket)
        self._minded = [(self.publisher, self.publisher.socket), (self.control, self.control.socket)]
        self._turns = cycle(self.channels.values())
        _settle()
        next_tick = deadline = 0.0
        while not self._stop:
            timeout_s = max(next_tick, deadline) - time.monotonic()
            ready = self._waiter.wait(timeout_s)
            stood = self._lateness.stood_still(timeout_s)
            self._serve([self._by_socket[socket] for socket in ready if socket in self._by_socket], stood)
            if self.control.socket in ready:
                self.control.serve_once()
            if self.publisher.socket in ready:
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
        """When there is something to do even if nothing arrives: a heartbeat is due, or silence has to be reported."""
        return min((channel.heartbeat.deadline(SILENT_S) for channel in self.channels.values()), default=0.0)

    def close(self) -> None:
        for channel in self.channels.values():
            channel.feed.close()
        self._lateness.close()
        self.control.close()
        self.publisher.close()
        self._waiter.close()

    # frames

    def _serve(self, channels: list[Channel], stood: bool = False) -> None:
        """Process what waits at these channels; the newest frames of several skins together."""
        work = [(channel, frame) for channel in channels for frame in self._waiting(channel, stood)]
        if len(work) > 1 and self.config.skip.batch:
            try:
                type(work[0][0].stage).together([(channel.stage, frame) for channel, frame in work])
            except Exception as why:  # each frame is still processed by itself
                text = "%s: frames of several skins could not be processed together (further such failures are counted)"
                self._log_failure(work[0][0], why, text)
        for channel, frame in work:
            self._handle(channel, frame)

    def _waiting(self, channel: Channel, stood: bool) -> list[Frame]:
        """The frames to process: the newest one of a socket, or all of a feed's that are not late."""
        frames: list[Frame] = []
        while len(frames) < AT_ONCE and (frame := channel.feed.recv()) is not None:
            frames.append(frame)
            if isinstance(channel.feed, StageReader) and not channel.feed.more:
                return frames
        news = self._lateness.news(frames, stood)
        channel.heartbeat.drops["late"] += len(frames) - len(news)
        return news

    def _handle(self, channel: Channel, frame: Frame) -> None:
        beat, stage = channel.heartbeat, channel.stage
        now = time.monotonic_ns()
        beat.received(frame, now)
        try:
            late = self._hand_on(channel, stage.process(frame, channel.wanted))
            self._hand_on(channel, stage.beside(channel.wanted), late)
        except Exception as why:
            self._failed(channel, why)
            return
        beat.done(frame, now, time.monotonic_ns(), bool(late))
        if stage.lacks and not channel.asleep and isinstance(channel.feed, StageReader):
            channel.feed.ask_again()
        self._frames += 1

    def _hand_on(self, channel: Channel, made: Sequence[Frame], late: bool | None = None) -> bool | None:
        """Send what was made of a frame, stamped. late: whether that frame was too old; None: the first of these says.
        Returns whether it was; None where nothing was made.
        """
        done = time.monotonic_ns()
        for out in made:
            if out.host in ("", host_id()):  # whose clock the stamps are of
                out.stamps.setdefault(channel.stage.stamp, done)
            late = self._lateness.late(out) if late is None else late
            if late:
                invalidate(out, "late")
            self._send(channel, out)
        return late

    def _joined(self, prefix: bytes) -> None:
        """Somebody has subscribed to topics with this prefix."""
        for channel in self.channels.values():
            for topic, head in channel.heads.items():
                if covers(prefix, head):
                    channel.stage.joined(topic)

    def _prepare(self) -> None:
        """Do one piece of work for later, while no frame waits. Channels take turns, because asking all of them costs
        time.
        """
        if self._frames >= WARM_FRAMES and not self._settled:
            self._settled = True
            _settle()
        else:
            channel = next(self._turns)
            try:
                channel.stage.prepare()
            except Exception as why:  # the work is done when it is needed, or fails then
                self._log_failure(channel, why, "%s: could not prepare (further such failures are counted)")

    def _send(self, channel: Channel, frame: Frame) -> None:
        try:
            self.publisher.send(frame)
            channel.heartbeat.sent[TOPIC_OF[type(frame)].name] += 1
        except (FrameError, zmq.ZMQError) as why:
            self._failed(channel, why)

    def _wanted(self, stage: Stage) -> frozenset[str]:
        """The topics that the stage is to make: those with subscribers, unless skin.toml asks for all."""
        if not self.config.skip.unwanted:
            return frozenset(stage.writes)
        return frozenset(topic for topic in stage.writes if self.publisher.wanted(topic, stage.skin))

    def _failed(self, channel: Channel, why: Exception) -> None:
        channel.heartbeat.drops["failed"] += 1
        channel.heartbeat.failure = f"a frame could not be processed: {type(why).__name__}: {why}"
        self._log_failure(channel, why, "%s: a frame was dropped (further such failures are counted)")

    @staticmethod
    def _log_failure(channel: Channel, why: Exception, text: str) -> None:
        channel.heartbeat.failures += 1
        if channel.failures.worth_a_line(why, text):
            log.exception(text, channel.stage.skin, exc_info=why)
        else:
            channel.heartbeat.unlogged += 1

    # housekeeping

    def _mind_sockets(self) -> list[str]:
        """Mend our sockets where needed; returns what status should say about them."""
        for place, (owner, socket) in enumerate(self._minded):
            if owner.mind():
                self._waiter.exchange(socket, owner.socket)
                self._minded[place] = (owner, owner.socket)
        return self.publisher.problems + self.control.problems

    def _tick(self) -> None:
        self.publisher.poll()
        problems = self.problems + self._mind_sockets()
        now = time.monotonic()
        for channel in self.channels.values():
            self._mind(channel, problems, now)

    def _mind(self, channel: Channel, problems: list[str], now: float) -> None:
        """All that a channel needs between frames: what is wanted of it, its status and info, and its state kept."""
        stage, feed, beat = channel.stage, channel.feed, channel.heartbeat
        channel.wanted = self._wanted(stage)
        self._sleep_or_wake(channel)
        if isinstance(feed, StageReader):
            feed.mind()
        beat.drops["malformed"], beat.drops["skipped"] = feed.malformed, feed.skipped
        try:
            stage.between_frames()
        except Exception as why:  # what could not be adopted is not in use
            self._log_failure(channel, why, "%s: could not adopt (further such failures are counted)")
        health = stage.health().with_problems([*problems, *([channel.unkept] if channel.unkept else [])])
        explained = not stage.reads and health.level == "ERROR"  # a source says itself why it gives nothing
        silent = "" if channel.asleep or explained else beat.silence(SILENT_S, stage.reads)
        status = beat.status(health, silent, now, HEARTBEAT_S, asleep=channel.asleep)
        if status is not None:
            self._send(channel, status)
        info = stage.info()
        if info is not None:
            age = {}
            if info.get("tare_sample_ns"):
                age["tare_age_s"] = (time.monotonic_ns() - info["tare_sample_ns"]) * 1e-9
            self._send(channel, InfoFrame(skin=stage.skin, process=self.process, valid=True, info=info | age))
        if stage.persists and (saved := stage.saved()) is not None:
            channel.unkept = persistence.save(self.process, stage.skin, saved)

    def _sleep_or_wake(self, channel: Channel) -> None:
        """A stage whose frames nobody reads does not read either, so that upstream need not work for it."""
        if not channel.stage.sleeps or not isinstance(channel.feed, StageReader):
            return
        idle = not channel.wanted
        if idle != channel.asleep:
            channel.asleep = idle
            channel.feed.listen(not idle)
            if not idle:
                channel.stage.wake()

    def _restore(self, channel: Channel) -> None:
        found = persistence.restore(self.process, channel.stage.skin)
        if found is None:
            return
        try:
            channel.stage.restore(*found)
            log.info("%s: took over the baseline of %.0f s ago", channel.stage.skin, found[1])
        except Refused as why:
            log.warning("%s: %s", channel.stage.skin, why)

    def _on_signal(self) -> None:
        self._stop = True


def _settle() -> None:
    """Take all living objects to be permanent: the garbage collector never walks them again, and the others seldom. The
    first call takes some ten milliseconds, later ones a fraction of that.
    """
    gc.collect()
    gc.freeze()
    gc.set_threshold(20_000, 50, 50)
