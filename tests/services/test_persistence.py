"""A kept state comes back as it was, or not at all: nothing that is damaged, foreign, too large or of tomorrow."""

from __future__ import annotations

import hashlib
import logging
import os
import time
from collections.abc import Callable
from pathlib import Path

import msgpack
import numpy as np
import pytest

from services.runtime import persistence

STATE = {"baseline": {"z0": np.linspace(1, 2, 5), "frames": 64}, "quiet_s": 1.5}


@pytest.fixture
def kept(runtime: Path) -> Path:
    persistence.save("preprocessing", "palm", STATE)
    return runtime / "state" / "preprocessing-palm.msgpack"


def restored() -> tuple[dict, float] | None:  # type: ignore[type-arg]
    return persistence.restore("preprocessing", "palm")


def sealed(content: object) -> bytes:
    packed: bytes = msgpack.packb(content)
    return hashlib.sha256(packed).digest() + packed


def test_what_was_kept_comes_back(kept: Path) -> None:
    found = restored()
    assert found is not None and 0 <= found[1] < 60
    assert np.array_equal(found[0]["baseline"]["z0"], STATE["baseline"]["z0"])  # type: ignore[index]
    assert found[0]["quiet_s"] == 1.5
    assert kept.stat().st_mode & 0o077 == 0 and [p.name for p in kept.parent.iterdir()] == [kept.name]


def test_nothing_kept_is_no_state_and_no_warning(runtime: Path, caplog: pytest.LogCaptureFixture) -> None:
    assert restored() is None and not caplog.records


def _replace_by_link(path: Path) -> None:
    path.rename(path.with_name("elsewhere"))
    path.symlink_to("elsewhere")


def _replace_by_pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def _link_the_folder(path: Path) -> None:
    path.parent.rename(path.parent.with_name("elsewhere"))
    path.parent.symlink_to("elsewhere")


def _age(path: Path, seconds: float) -> None:
    state = persistence.plain(STATE)
    path.write_bytes(sealed({"saved_unix_s": time.time() + seconds, "state": state}))


SPOILT: dict[str, tuple[Callable[[Path], object], str]] = {
    "one bit": (lambda p: p.write_bytes(p.read_bytes()[:-1] + bytes([p.read_bytes()[-1] ^ 1])), "checksum"),
    "cut short": (lambda p: p.write_bytes(p.read_bytes()[:-10]), "checksum"),
    "empty": (lambda p: p.write_bytes(b""), "checksum"),
    "without its checksum": (lambda p: p.write_bytes(p.read_bytes()[32:]), "checksum"),
    "too large": (lambda p: os.truncate(p, 2**40), "at most"),
    "of tomorrow": (lambda p: _age(p, 86400.0), "from now"),
    "of no time": (lambda p: _age(p, float("nan")), "from now"),
    "of no state": (lambda p: p.write_bytes(sealed({"saved_unix_s": 0.0, "state": [1]})), "expected a map"),
    "with an array that is none": (
        lambda p: p.write_bytes(
            sealed({"saved_unix_s": 0.0, "state": {"z": {"dtype": "<f8", "shape": [2**40, 2**40, 0], "data": b""}}})
        ),
        "dimensions",
    ),
    "a link": (_replace_by_link, "Too many levels"),
    "a pipe": (_replace_by_pipe, "a pipe"),
    "in a linked folder": (_link_the_folder, "Not a directory"),
    "open to others": (lambda p: p.chmod(0o666), "others can write"),
    "in a folder open to others": (lambda p: p.parent.chmod(0o777), "others can write"),
}


@pytest.mark.parametrize("how", SPOILT)
def test_a_state_that_is_not_to_be_believed_is_left_and_named(
    kept: Path, how: str, caplog: pytest.LogCaptureFixture
) -> None:
    spoil, says = SPOILT[how]
    spoil(kept)
    with caplog.at_level(logging.WARNING):
        assert restored() is None
    assert says in caplog.text and "starting without it" in caplog.text


def test_a_state_of_another_user_is_left(kept: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours = os.geteuid()
    monkeypatch.setattr(persistence.os, "geteuid", lambda: ours + 1)
    monkeypatch.setattr(persistence, "runtime_dir", lambda: kept.parent.parent)
    assert restored() is None


def test_a_state_is_never_written_through_a_link(kept: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim"
    victim.write_text("mine")
    kept.unlink()
    kept.symlink_to(victim)
    kept.with_name(f"{kept.name}.{os.getpid()}").symlink_to(victim)
    persistence.save("preprocessing", "palm", STATE)
    assert victim.read_text() == "mine" and not kept.is_symlink() and restored() is not None
