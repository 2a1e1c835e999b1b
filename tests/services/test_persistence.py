"""A kept state comes back as it was or not at all; files take their place whole; folders of the compose file."""

import errno
import hashlib
import logging
import os
import time
from pathlib import Path

import msgpack
import numpy as np
import pytest

from bench.json_file import write_json
from protocol import whole_file
from protocol.keys import write_keys
from services import folders
from services.calibration import presses_csv
from services.folders import NotOurs, hand_over
from services.recordings import golden
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


@pytest.mark.parametrize(("spoil", "says"), [
    (lambda p: p.write_bytes(p.read_bytes()[:-1] + bytes([p.read_bytes()[-1] ^ 1])), "checksum"),
    (lambda p: p.write_bytes(b""), "checksum"),
    (lambda p: os.truncate(p, 2**40), "at most"),
    (lambda p: sealed(time.time() + 86400.0, persistence.plain(STATE))(p), "from now"),
    (sealed(float("nan"), persistence.plain(STATE)), "from now"),
    (sealed(0.0, [1]), "expected a map"),
    (sealed(0.0, {"z": {"dtype": "<f8", "shape": [2**40, 2**40, 0], "data": b""}}), "dimensions"),
    (lambda p: p.chmod(0o666), "others can write"),
])  # fmt: skip
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


REASONS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO, errno.EFBIG)
WRITERS = {
    "text": lambda at: whole_file.write_whole(at / "a.txt", "new"),
    "through a link": lambda at: whole_file.write_whole(at / "link", "new"),
    "keys": lambda at: write_keys(at, "one"),
    "golden": lambda at: golden.accept(at / "a.mcap", []),
    "presses": lambda at: presses_csv.write(at / "a.csv", []),
    "report": lambda at: write_json(at / "a.json", {}),
}


def tree(at):
    return {path.name: (path.read_bytes(), path.lstat().st_mode) for path in at.iterdir() if path.is_file()}


def refusing(number):
    def refuse(*_, **__):
        raise OSError(number, os.strerror(number))

    return refuse


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("writer", WRITERS)
def test_what_was_there_stays_and_the_error_names_the_file(tmp_path, monkeypatch, writer, step):
    for name in ("a.txt", "one.key", "one.key_secret", "a.golden", "a.csv", "a.json"):
        (tmp_path / name).write_text("good")
    (tmp_path / "link").symlink_to(tmp_path / "a.txt")
    before = tree(tmp_path)
    for number in REASONS:
        with monkeypatch.context() as fails:
            fails.setattr(whole_file.os, step, refusing(number))
            with pytest.raises(OSError) as found:
                WRITERS[writer](tmp_path)
        assert found.value.errno == number and Path(found.value.filename).parent == tmp_path
        assert tree(tmp_path) == before
    WRITERS[writer](tmp_path)
    assert tree(tmp_path) != before and tree(tmp_path).keys() == before.keys() and (tmp_path / "link").is_symlink()


def test_a_state_that_cannot_be_kept_is_said_and_the_one_before_stays(runtime, monkeypatch):
    assert persistence.save("preprocessing", "palm", {"n": 1}) == ""
    for step, number in (("replace", errno.ENOSPC), ("open", errno.EROFS), ("replace", errno.EIO)):
        with monkeypatch.context() as fails:
            fails.setattr(persistence.os, step, refusing(number))
            assert os.strerror(number) in persistence.save("preprocessing", "palm", {"n": 2})
        found = persistence.restore("preprocessing", "palm")
        assert found is not None and found[0] == {"n": 1} and len(list((runtime / "state").iterdir())) == 1


UID = 54321
HERE = "/tmp/eitskin-1000"


@pytest.fixture
def changed(monkeypatch):
    """What is changed (kept from really being so); folders belong to root but for two names."""
    done, real, owners = [], os.fstat, {"user": UID, "another": UID + 1}

    def path(fd):
        return os.readlink(f"/proc/self/fd/{fd}")

    def fstat(fd):
        owner = owners.get(os.path.basename(path(fd)), 0)
        return os.stat_result((*(found := real(fd))[:4], owner, *found[5:10]))

    monkeypatch.setattr(folders.os, "fchown", lambda fd, uid, gid: done.append((path(fd), uid)))
    monkeypatch.setattr(folders.os, "fchmod", lambda fd, mode: done.append((path(fd), mode)))
    monkeypatch.setattr(folders.os, "fstat", fstat)
    return done


@pytest.mark.parametrize(("kind", "source", "name", "says"), [
    ("new", HERE, HERE, ""),
    ("new", "/etc", HERE, "is a link to /etc"),
    ("full", HERE, HERE, "is not empty"),
    ("another", HERE, HERE, f"belongs to user {UID + 1}"),
    ("elsewhere", HERE, HERE, "no mounted folder"),
])  # fmt: skip
def test_what_the_engine_made_is_handed_over_while_it_is_empty(tmp_path, changed, kind, source, name, says):
    made = tmp_path / kind
    made.mkdir(0o755)  # the services refuse such a runtime folder
    at = tmp_path if kind == "elsewhere" else made
    mounted = f"22 1 8:1 / / rw - ext4 /dev/sda rw\n99 22 8:1 {source} {at} rw,relatime - ext4 /dev/sda rw\n"
    if says:
        (made / "passwd").touch() if kind == "full" else None
        with pytest.raises(NotOurs, match=says):
            hand_over(str(made), name, UID, UID, mounted)
        assert not changed
        return
    assert "now belongs" in hand_over(str(made), name, UID, UID, mounted)
    assert changed == [(str(made), UID), (str(made), 0o700)]
    (made / "frame").touch()
    assert "already" in hand_over(str(made), name, 0, 0, mounted) and len(changed) == 2
