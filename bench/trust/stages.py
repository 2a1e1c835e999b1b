"""What is judged: raw frames in, contact frames out. This checkout's stages, or another's in a process of its own.

This file is also the program of that process, run by the other checkout's Python in that checkout. So it imports only
what every checkout has. A request is a letter, a length and so many bytes, an answer a length and so many. S: the
skin's settings in JSON, answered by the schema that is read here; N: a session begins; A: what is done to the stages;
R: a raw frame.
"""

from __future__ import annotations

import json
import os
import struct
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from typing import Any, BinaryIO, Protocol

import services  # noqa: F401  (one thread for the numerical libraries)
from models.bundle import Bundle
from protocol.frames import SCHEMA, ContactFrame, RawFrame, pack, unpack
from services.pipeline import Pipeline
from services.runtime.config import Skin
from services.runtime.stage import Refused

AGED_S = 3000.0  # how old the baseline is with which stages that `age` begin
FIT_S = 300.0  # a fit of the mounting takes seconds
ANSWER = struct.Struct("<d?")  # of a raw frame: CPU seconds so far, refused; then the contact frame


class Judged(Protocol):
    """Used for one session after the other."""

    cpu_s: float  # of its frames so far

    def reset(self) -> None:
        """A session begins: nothing is known."""

    def step(self, raw: RawFrame) -> ContactFrame | None:
        """What would be published of it; None: nothing."""

    def act(self, name: str) -> None:
        """Do `tare`, as a person would ask for it, whether something touches or not; `lose`: preprocessing begins anew
        without what it kept, the other stages go on; `age`: all begin anew, with what preprocessing kept AGED_S ago.
        """

    @property
    def refused(self) -> bool:
        """Whether the image on which the last contact frame stands is not valid; False where it stands on none."""


class Today:
    """The stages that the services of the checkout run."""

    def __init__(self, skin: Skin, bundle: Bundle) -> None:
        self._skin, self._bundle = skin, bundle
        self.reset()

    def reset(self) -> None:
        self.cpu_s = 0.0
        self.stages = Pipeline(self._skin, f"palm-{os.getpid()}", self._bundle)  # others keep what theirs found
        self.stages.pre.warm_up()
        self._said: ContactFrame | None = None

    def step(self, raw: RawFrame) -> ContactFrame | None:
        began = time.process_time()
        self.stages.prepare()
        self._said = self.stages.step(raw)
        self.cpu_s += time.process_time() - began
        return self._said

    def act(self, name: str) -> None:
        try:
            {"tare": self._tare, "lose": self.stages.pre.reset, "age": self._age}[name]()
        except Refused:  # something touches, or what was kept is of something that did
            return

    @property
    def refused(self) -> bool:
        image, said = self.stages.image, self._said
        return image is not None and said is not None and image.scan == said.scan and not image.valid

    def _tare(self) -> None:
        """A fit that this begins is waited for."""
        self.stages.pre.command("tare", {})
        waited = time.monotonic() + FIT_S
        while self.stages.pre.linearisation.busy and time.monotonic() < waited:
            self.stages.prepare()
            time.sleep(0.02)

    def _age(self) -> None:
        saved = self.stages.pre.saved()
        self.stages.reset()
        if saved is not None:
            self.stages.pre.restore(saved, AGED_S)


class OtherCheckout:
    """The stages of another checkout, in a process that knows nothing of ours."""

    def __init__(self, checkout: Path, skin: Skin) -> None:
        self.cpu_s, self.refused = 0.0, False
        python = checkout / ".venv" / "bin" / "python"
        self._process = subprocess.Popen(
            [str(python) if python.exists() else sys.executable, "-P", __file__],
            cwd=checkout,
            env={**os.environ, "PYTHONPATH": str(checkout)},
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
        )
        settings = {"port": "stub", "bundle": skin.bundle, "frame_id": "palm", "scan": skin.scan}
        self._schema = min(SCHEMA, int(self._asked(b"S", json.dumps(settings).encode())))

    def reset(self) -> None:
        self._asked(b"N")
        self.cpu_s, self.refused = 0.0, False

    def step(self, raw: RawFrame) -> ContactFrame | None:
        """The raw frame goes in the schema that is read there: raw and contact frames of all schemas differ by no field
        that lacks a default.
        """
        answer = self._asked(b"R", pack(replace(raw, schema=self._schema)))
        self.cpu_s, self.refused = ANSWER.unpack_from(answer)
        return unpack(answer[ANSWER.size :]) if len(answer) > ANSWER.size else None  # type: ignore[return-value]

    def act(self, name: str) -> None:
        self._asked(b"A", name.encode())

    def _asked(self, kind: bytes, content: bytes = b"") -> bytes:
        assert self._process.stdin is not None and self._process.stdout is not None
        self._process.stdin.write(struct.pack("<cI", kind, len(content)) + content)
        self._process.stdin.flush()
        head = self._process.stdout.read(4)
        if len(head) < 4:
            raise RuntimeError("the stages of the other checkout have ended; what they said is above")
        return self._process.stdout.read(struct.unpack("<I", head)[0])


def answered(judged: Today | None, kind: bytes, content: bytes) -> tuple[Today, bytes]:
    if judged is None:
        skin = Skin.model_validate(json.loads(content))
        return Today(skin, Bundle.load(skin.bundle)), str(SCHEMA).encode()
    if kind == b"R":
        raw: Any = unpack(content)
        said = judged.step(raw)
        return judged, ANSWER.pack(judged.cpu_s, judged.refused) + (b"" if said is None else pack(said))
    if kind == b"A":
        judged.act(content.decode())
    else:
        judged.reset()
    return judged, b""


def serve(requests: BinaryIO, answers: BinaryIO) -> None:
    judged: Today | None = None
    while len(head := requests.read(5)) == 5:
        kind, length = struct.unpack("<cI", head)
        judged, answer = answered(judged, kind, requests.read(length))
        answers.write(struct.pack("<I", len(answer)) + answer)
        answers.flush()


if __name__ == "__main__":
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever is printed is no answer
    serve(sys.stdin.buffer, answers)
