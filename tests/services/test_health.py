"""A container's healthcheck: every configured skin, and what each kind of process says of itself."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
import zmq

from protocol.sockets import ControlError, ControlServer
from services import health

pytestmark = pytest.mark.live

Answer = Callable[[dict[str, Any]], dict[str, Any]]


@contextlib.contextmanager
def process(name: str, status: Answer) -> Iterator[None]:
    """A process with a control socket that knows nothing but `status`."""
    server = ControlServer(name, {"status": status}, context=zmq.Context.instance())
    stop = threading.Event()

    def serve() -> None:
        while not stop.is_set():
            server.serve_once(0.02)

    thread = threading.Thread(target=serve)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
        server.close()


def stage(flowing: dict[str, bool]) -> Answer:
    """A stage's answer; without `skin` it speaks of the first, as runners do."""

    def status(args: dict[str, Any]) -> dict[str, Any]:
        skin = args.get("skin") or next(iter(flowing))
        if skin not in flowing:
            raise ControlError("bad_request", f"no skin called {skin!r}")
        return {"flowing": flowing[skin], "quiet_s": 7.0, "messages": [f"{skin} is unplugged"]}

    return status


@pytest.mark.parametrize(
    ("flowing", "expected"),
    [
        ({"palm": True, "back": True}, []),
        ({"palm": True, "back": False}, ["no frames of back for 7.0 s", "back is unplugged"]),
        ({"palm": False, "back": False}, ["no frames of palm", "no frames of back"]),
        ({"palm": True}, ["no skin called 'back'"]),
    ],
)
def test_a_stage_is_asked_for_every_skin(runtime: Path, flowing: dict[str, bool], expected: list[str]) -> None:
    with process("inference", stage(flowing)):
        found = health.check("inference", ["palm", "back"])
    assert all(text in found for text in expected) and bool(found) == bool(expected)


@pytest.mark.parametrize(
    ("status", "expected"),
    [
        ({"scanning": True, "plugged": True}, ""),
        ({"scanning": False, "plugged": True}, "stub: not scanning"),
        ({"scanning": True, "plugged": False}, "stub: unplugged"),
    ],
)
def test_the_stub_is_well_while_it_scans(runtime: Path, status: dict[str, Any], expected: str) -> None:
    with process("stub", lambda args: status):
        found = health.check("stub", ["palm"])
    assert found.startswith(expected) and bool(found) == bool(expected)


@pytest.mark.parametrize(("growing", "well"), [("raw/palm", True), ("contact/palm", True), ("status/palm", False)])
def test_a_recorder_is_well_while_frames_are_recorded(
    runtime: Path, monkeypatch: pytest.MonkeyPatch, growing: str, well: bool
) -> None:
    counts = {"raw/palm": 10, "contact/palm": 10, "status/palm": 3, "info/palm": 1, "state/palm": 1}

    def status(args: dict[str, Any]) -> dict[str, Any]:
        counts[growing] += 5
        return {"file": "x.mcap", "messages": dict(counts), "gaps": 0}

    monkeypatch.setattr(health, "GROWING_S", 0.01)
    with process("recorder", status):
        found = health.check("recorder", ["palm"])
    assert (found == "") is well


def test_a_process_that_is_not_there_is_named(runtime: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(health, "TIMEOUT_S", 0.05)
    assert health.check("publisher", ["palm"]).startswith("publisher: publisher does not answer")


def test_a_configuration_that_cannot_be_read_is_said(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setenv("EITSKIN_CONFIG", str(tmp_path / "none.toml"))
    monkeypatch.setattr("sys.argv", ["health", "publisher"])
    assert health.main() == 1
    assert "none.toml: cannot be read" in capsys.readouterr().out
