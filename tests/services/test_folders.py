"""What the root helper of the compose file changes: an empty folder of root, mounted from its own name, and no more."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

import pytest

from services import folders
from services.folders import NotOurs, hand_over

UID = 54321


@pytest.fixture
def changed(monkeypatch: pytest.MonkeyPatch) -> Iterator[list[tuple[str, int]]]:
    """What is changed (kept from really being so), and a folder's owner taken from `OWNERS`."""
    done: list[tuple[str, int]] = []
    monkeypatch.setattr(
        folders.os, "fchown", lambda fd, uid, gid: done.append((os.readlink(f"/proc/self/fd/{fd}"), uid))
    )
    monkeypatch.setattr(folders.os, "fchmod", lambda fd, mode: done.append((os.readlink(f"/proc/self/fd/{fd}"), mode)))
    real = os.fstat
    owners = {"user": UID, "another": UID + 1}

    def fstat(fd: int) -> os.stat_result:
        found = real(fd)
        owner = owners.get(Path(os.readlink(f"/proc/self/fd/{fd}")).name, 0)
        return os.stat_result((*found[:4], owner, *found[5:10]))

    monkeypatch.setattr(folders.os, "fstat", fstat)
    yield done


def mounts(folder: Path, source: str) -> str:
    return f"22 1 8:1 / / rw - ext4 /dev/sda rw\n99 22 8:1 {source} {folder} rw,relatime - ext4 /dev/sda rw\n"


def folder(tmp_path: Path, name: str) -> Path:
    (tmp_path / name).mkdir()
    return tmp_path / name


@pytest.mark.parametrize(
    ("source", "name"),
    [
        ("/tmp/eitskin-1000", "/tmp/eitskin-1000"),
        ("/eitskin-1000", "/tmp/eitskin-1000"),  # /tmp is a file system of its own
        ("/@home/u/recordings", "./recordings"),
        ("/home/a\\040b/recordings", "/home/a b/recordings"),
    ],
)
def test_what_the_engine_made_is_handed_over(
    tmp_path: Path, changed: list[tuple[str, int]], source: str, name: str
) -> None:
    made = folder(tmp_path, "new")
    assert "now belongs" in hand_over(str(made), name, UID, UID, mounts(made, source))
    assert changed == [(str(made), UID), (str(made), 0o700)]


def test_root_itself_gets_what_the_engine_made_for_everybody(tmp_path: Path, changed: list[tuple[str, int]]) -> None:
    made = folder(tmp_path, "new")
    made.chmod(0o755)  # the services refuse such a runtime folder
    assert "now belongs" in hand_over(str(made), "/tmp/new", 0, 0, mounts(made, "/tmp/new"))
    assert changed == [(str(made), 0), (str(made), 0o700)]
    (made / "frame").touch()
    assert "already" in hand_over(str(made), "/tmp/new", 0, 0, mounts(made, "/tmp/new")), "nothing but an empty one"
    assert len(changed) == 2


@pytest.mark.parametrize(
    ("kind", "source", "says"),
    [
        ("new", "/etc", "is a link to /etc"),
        ("new", "/var/empty/1000", "is a link to"),
        ("full", "/tmp/eitskin-1000", "is not empty"),
        ("another", "/tmp/eitskin-1000", f"belongs to user {UID + 1}"),
    ],
)
def test_what_is_not_ours_is_refused(
    tmp_path: Path, changed: list[tuple[str, int]], kind: str, source: str, says: str
) -> None:
    found = folder(tmp_path, kind)
    if kind == "full":
        (found / "passwd").touch()
    with pytest.raises(NotOurs, match=says):
        hand_over(str(found), "/tmp/eitskin-1000", UID, UID, mounts(found, source))
    assert not changed


def test_a_link_in_the_container_and_a_folder_of_the_users_are_left_as_they_are(
    tmp_path: Path, changed: list[tuple[str, int]]
) -> None:
    mine = folder(tmp_path, "user")
    (mine / "file").touch()
    assert "already" in hand_over(str(mine), "anything", UID, UID, "")
    (tmp_path / "link").symlink_to(mine)
    with pytest.raises(OSError, match="link|directory"):
        hand_over(str(tmp_path / "link"), "link", UID, UID, "")
    with pytest.raises(NotOurs, match="no mounted folder"):
        hand_over(str(folder(tmp_path, "new")), "new", UID, UID, mounts(mine, "/x"))
    assert not changed


def test_the_command_says_what_it_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert folders.main(["me"]) == 2
    assert folders.main([f"{os.getuid()}:{os.getgid()}", f"{tmp_path}=here", f"{tmp_path / 'none'}=there"]) == 1
    said = capsys.readouterr()
    assert "here belongs to user" in said.out and "none" in said.err
