"""What the root helper of the compose file changes: an empty folder of root, mounted from its own name, and no more."""

import os

import pytest

from services import folders
from services.folders import NotOurs, hand_over

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


@pytest.mark.parametrize(
    ("kind", "source", "name", "says"),
    [
        ("new", HERE, HERE, ""),
        ("new", "/etc", HERE, "is a link to /etc"),
        ("full", HERE, HERE, "is not empty"),
        ("another", HERE, HERE, f"belongs to user {UID + 1}"),
        ("elsewhere", HERE, HERE, "no mounted folder"),
    ],
)
def test_what_the_engine_made_is_handed_over_while_it_is_empty_and_nothing_else(
    tmp_path, changed, kind, source, name, says
):
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
