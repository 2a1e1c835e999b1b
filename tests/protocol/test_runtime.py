"""The runtime folder: whose it is, and that there is one service in it."""

import os
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from protocol import runtime as rt

pytestmark = pytest.mark.live


def test_it_is_made_for_us_alone(monkeypatch, tmp_path):
    monkeypatch.setenv("EITSKIN_RUNTIME", str(tmp_path / "a" / "b"))
    assert stat.S_IMODE(rt.runtime_dir().stat().st_mode) == 0o700
    assert rt.endpoint("publisher") == f"ipc://{tmp_path}/a/b/publisher.ipc"
    assert rt.control_endpoint("stub") == f"ipc://{tmp_path}/a/b/stub.ctl"


def test_the_order_of_places(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.delenv("EITSKIN_RUNTIME", raising=False)
    assert rt.runtime_dir() == tmp_path / "eitskin"
    monkeypatch.setenv("EITSKIN_RUNTIME", str(tmp_path / "own"))
    assert rt.runtime_dir() == tmp_path / "own"


def make_open(path):
    path.mkdir(mode=0o755)


def make_link(path):
    path.with_name("elsewhere").mkdir(mode=0o700)
    path.symlink_to(path.with_name("elsewhere"))


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (make_open, "mode 0755, expected 0700: chmod 700"),
        (make_link, "symbolic link"),
        (lambda path: path.write_text(""), "not a folder"),
    ],
)
def test_an_unsafe_folder_is_refused(monkeypatch, tmp_path, make, says):
    make(tmp_path / "run")
    monkeypatch.setenv("EITSKIN_RUNTIME", str(tmp_path / "run"))
    with pytest.raises(rt.RuntimeDirError, match=says):
        rt.runtime_dir()


def test_a_foreign_folder_is_refused(monkeypatch, runtime):
    monkeypatch.setattr(os, "geteuid", lambda: 12345)
    with pytest.raises(rt.RuntimeDirError, match="expected 12345"):
        rt.runtime_dir()


def test_a_path_too_long_for_a_socket_is_refused(monkeypatch, tmp_path):
    monkeypatch.setenv("EITSKIN_RUNTIME", str(tmp_path / ("x" * 100)))
    with pytest.raises(rt.RuntimeDirError, match="at most 107"):
        rt.endpoint("publisher")


def test_a_second_service_is_refused_and_the_lock_goes_with_its_process(runtime):
    code = "import time; from protocol.runtime import lock\nwith lock(): print('held', flush=True); time.sleep(30)"
    holder = subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, cwd=Path(rt.__file__).parents[1])
    assert holder.stdout.readline() == b"held\n"
    with pytest.raises(rt.AlreadyRunning, match=f"in use by process {holder.pid}"):
        with rt.lock():
            pass
    holder.kill()
    holder.communicate()
    for _ in range(50):
        try:
            with rt.lock() as folder:
                assert (folder / "lock").read_text() == f"{os.getpid()}\n"
            break
        except rt.AlreadyRunning:  # pragma: no cover - the kernel has not quite let go
            time.sleep(0.02)
    else:
        pytest.fail("the lock outlived its process")
