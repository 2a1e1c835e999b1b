"""Who fits the touches that services/refinement.py hands over: a process of its own, niced, for all skins of a service;
or the service itself at once, for frames from a file.

One job is under way at a time. Of each skin the newest waits, and what a newer one replaces is counted. A process that
ends or gives no answer is started again, after ever longer pauses.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
import threading
import time
from multiprocessing.connection import Connection
from queue import Empty, SimpleQueue

from models.refine import RefineAnswer, RefineJob, Refiner
from services.runtime.config import ROOT

log = logging.getLogger(__name__)

STUCK_S = 30.0  # a fit that takes longer on however busy a machine has failed
WAIT_S = (1.0, 60.0)  # before a fit's process that ended is started again: at first, and at most


class RefineProcess:
    """The process that fits, for all skins of this one. `offer` and `poll` never wait."""

    def __init__(self, command: tuple[str, ...] = (sys.executable, "-m", "models.refine")) -> None:
        self._command = command
        self._process: subprocess.Popen[bytes] | None = None
        self._to: Connection | None = None
        self._read: SimpleQueue[RefineAnswer | None] = SimpleQueue()  # None: there will be no more
        self._waiting: dict[str, RefineJob] = {}  # the newest of each skin
        self._begun: RefineJob | None = None
        self._begun_s = self._not_before_s = 0.0
        self._pause_s = WAIT_S[0]
        self._answers: dict[str, RefineAnswer] = {}
        self.skipped: dict[str, int] = {}  # jobs that a newer one of their skin replaced, or that were lost
        self.problem = ""

    def start(self) -> None:
        """Before the first job; where it cannot be started, the first job says so."""
        try:
            if self._process is None:
                self._start()
        except OSError as why:
            log.warning("the process that refines touches cannot be started (%s)", why)

    def offer(self, job: RefineJob) -> None:
        if job.skin in self._waiting:
            self._skip(job.skin)
        self._waiting[job.skin] = job
        self._next()

    def poll(self, skin: str) -> RefineAnswer | None:
        """The newest answer for a skin, once. The next job waits for what the skin offers now that it knows the answer:
        a fit that begins there takes a fraction of the time.
        """
        if self._begun is not None:
            self._receive()
        answer = self._answers.pop(skin, None)
        if answer is None:
            self._next()
        return answer

    def close(self) -> None:
        if self._to is not None:
            self._to.close()
        if self._process is not None:
            self._process.kill()
            self._process.wait()
        self._process = self._to = self._begun = None

    def _receive(self) -> None:
        try:
            answer = self._read.get_nowait()
        except Empty:
            if time.monotonic() > self._begun_s + STUCK_S:
                self._lost(f"gave no answer within {STUCK_S:.0f} s")
            return
        if answer is None:
            return self._lost("ended")
        self._answers[answer.skin] = answer
        self._begun, self._pause_s, self.problem = None, WAIT_S[0], ""

    def _lost(self, why: str) -> None:
        assert self._begun is not None
        self._skip(self._begun.skin)
        self.close()
        self.problem = f"the process that refines touches {why}; it is started again"
        log.warning("%s", self.problem)
        self._not_before_s, self._pause_s = time.monotonic() + self._pause_s, min(2 * self._pause_s, WAIT_S[1])

    def _next(self) -> None:
        """Hand over one job: so little waits in the pipe that writing never does."""
        if self._begun is not None or not self._waiting or time.monotonic() < self._not_before_s:
            return
        skin = next(iter(self._waiting))
        self._begun, self._begun_s = self._waiting.pop(skin), time.monotonic()
        try:
            if self._process is None:
                self._start()
            assert self._to is not None
            self._to.send(self._begun)
        except OSError as why:
            self._lost(f"cannot be used ({why})")

    def _start(self) -> None:
        self._process = subprocess.Popen(
            self._command,
            cwd=ROOT,
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=os.environ | {"OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"},
        )
        assert self._process.stdin is not None and self._process.stdout is not None
        with self._process.stdin as stdin, self._process.stdout as stdout:
            self._to = Connection(os.dup(stdin.fileno()), readable=False)
            answers = Connection(os.dup(stdout.fileno()), writable=False)
        self._read = SimpleQueue()
        threading.Thread(target=_reading, args=(answers, self._read), daemon=True).start()

    def _skip(self, skin: str) -> None:
        self.skipped[skin] = self.skipped.get(skin, 0) + 1


class RefineHere:
    """The same at once: for frames from a file, and to measure."""

    def __init__(self) -> None:
        self._refiner = Refiner()
        self._answers: dict[str, RefineAnswer] = {}
        self.skipped: dict[str, int] = {}
        self.problem = ""

    def start(self) -> None:
        """There is nothing to start."""

    def offer(self, job: RefineJob) -> None:
        self._answers[job.skin] = self._refiner(job)

    def poll(self, skin: str) -> RefineAnswer | None:
        return self._answers.pop(skin, None)


def _reading(answers: Connection, into: SimpleQueue[RefineAnswer | None]) -> None:
    """Until the process ends. A thread, because half of an answer would keep its reader waiting for the rest."""
    with answers:
        try:
            while True:
                into.put(answers.recv())
        except Exception as why:  # it ended, or wrote something else
            if not isinstance(why, EOFError | OSError):
                log.warning("the process that refines touches gave no answer but: %s", why)
            into.put(None)


_shared: RefineProcess | None = None


def shared() -> RefineProcess:
    """One process for all skins of this one."""
    global _shared
    _shared = _shared or RefineProcess()
    return _shared
