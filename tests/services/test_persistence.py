"""A kept state comes back as it was, or not at all: nothing that is damaged, foreign, too large or of tomorrow."""

import hashlib
import logging
import os
import time

import msgpack
import numpy as np
import pytest

from services.runtime import persistence

STATE = {"baseline": {"z0": np.linspace(1, 2, 5), "frames": 64}, "quiet_s": 1.5}


@pytest.fixture
def kept(runtime):
    persistence.save("preprocessing", "palm", STATE)
    return runtime / "state" / "preprocessing-palm.msgpack"


def restored():
    return persistence.restore("preprocessing", "palm")


@pytest.mark.parametrize("step_s", [0, -3600, 86400])
def test_what_was_kept_comes_back_as_old_as_it_is_whatever_the_systems_clock_does(kept, monkeypatch, caplog, step_s):
    assert persistence.restore("preprocessing", "heel") is None and not caplog.records, "nothing kept is no fault"
    real = time.time
    monkeypatch.setattr(time, "time", lambda: real() + step_s)
    state, age_s = restored()
    assert 0 <= age_s < 60 and state["quiet_s"] == 1.5
    assert np.array_equal(state["baseline"]["z0"], STATE["baseline"]["z0"])
    assert kept.stat().st_mode & 0o077 == 0 and [p.name for p in kept.parent.iterdir()] == [kept.name]


def sealed(saved_unix_s, state):
    packed = msgpack.packb({"saved_unix_s": saved_unix_s, "state": state})
    return lambda path: path.write_bytes(hashlib.sha256(packed).digest() + packed)


@pytest.mark.parametrize(
    ("spoil", "says"),
    [
        (lambda p: p.write_bytes(p.read_bytes()[:-1] + bytes([p.read_bytes()[-1] ^ 1])), "checksum"),
        (lambda p: p.write_bytes(b""), "checksum"),
        (lambda p: os.truncate(p, 2**40), "at most"),
        (lambda p: sealed(time.time() + 86400.0, persistence.plain(STATE))(p), "from now"),
        (sealed(float("nan"), persistence.plain(STATE)), "from now"),
        (sealed(0.0, [1]), "expected a map"),
        (sealed(0.0, {"z": {"dtype": "<f8", "shape": [2**40, 2**40, 0], "data": b""}}), "dimensions"),
        (lambda p: p.chmod(0o666), "others can write"),
    ],
)
def test_a_state_that_is_not_to_be_believed_is_left_and_named(kept, spoil, says, caplog):
    spoil(kept)
    with caplog.at_level(logging.WARNING):
        assert restored() is None
    assert says in caplog.text and "starting without it" in caplog.text


def test_a_state_of_another_user_is_left(kept, monkeypatch):
    ours = os.geteuid()
    monkeypatch.setattr(persistence.os, "geteuid", lambda: ours + 1)
    monkeypatch.setattr(persistence, "runtime_dir", lambda: kept.parent.parent)
    assert restored() is None
