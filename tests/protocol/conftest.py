import shutil
import tempfile

import pytest
import zmq


@pytest.fixture
def runtime(monkeypatch):
    """A runtime folder of the test's own, its path short enough for sockets."""
    folder = tempfile.mkdtemp(prefix="skin", dir="/tmp")
    monkeypatch.setenv("EITSKIN_RUNTIME", folder)
    yield folder
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def context():
    """A ZeroMQ context of the test's own: what the test leaves open is closed with it."""
    own = zmq.Context()
    yield own
    own.destroy(linger=0)
