"""Fixtures that more than one folder of tests uses."""

from tests import pinned

pinned.pin()  # before anything imports numpy

# ruff: noqa: E402
import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from pathlib import Path

import hypothesis
import pytest

from tests.needs import ROOT, pytest_terminal_summary  # noqa: F401  (the last is a hook of pytest)
from tests.waiting import end, until

# The same examples every time, so that nothing fails by chance; `make search` looks for others.
SLOW = [hypothesis.HealthCheck.too_slow]
hypothesis.settings.register_profile("same", derandomize=True, database=None, deadline=None, suppress_health_check=SLOW)
if not os.environ.get("EITSKIN_SEARCH"):
    hypothesis.settings.load_profile("same")

if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # started in the background: programs we start would inherit that
    signal.signal(signal.SIGINT, signal.default_int_handler)


class FailuresAtOnce:
    """Names a test when it fails: a run that is cut off has not told its failures otherwise."""

    def __init__(self, terminal):
        self._terminal = terminal

    def pytest_runtest_logreport(self, report):
        if report.failed:
            self._terminal.write_line(f"\nFAILED {report.nodeid}")
            self._terminal.write_line(str(report.longrepr)[-1500:])


@pytest.hookimpl(trylast=True)
def pytest_configure(config):
    os.environ.pop("EITSKIN_RUNTIME", None)
    terminal = config.pluginmanager.get_plugin("terminalreporter")
    if terminal is not None and not hasattr(config, "workerinput"):
        config.pluginmanager.register(FailuresAtOnce(terminal))


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(items):
    """Of tests with many cases that take long the gate asks every third; some it leaves anyway."""
    many = [item for item in items if item.get_closest_marker("many") and not item.get_closest_marker("release")]
    for item in many[1::3] + many[2::3]:
        item.add_marker("release")


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup():
    pinned.seed()


def _folder(patch):
    """With a path short enough for sockets."""
    with tempfile.TemporaryDirectory(prefix="eit", dir="/tmp", ignore_cleanup_errors=True) as folder:
        patch.setenv("EITSKIN_RUNTIME", folder)
        yield Path(folder)


@pytest.fixture
def runtime(monkeypatch):
    yield from _folder(monkeypatch)


@pytest.fixture(autouse=True)
def _no_runtime_of_the_user(request):
    """Every test has a runtime folder that no other test and no service of the user has."""
    if "EITSKIN_RUNTIME" not in os.environ:  # a service that a file shares has set its own
        request.getfixturevalue("runtime")


def without_recorder(folder, scan):
    """The shipped configuration without its recorder, which listens to every contact and keeps the publisher awake."""
    lines = (ROOT / "skin.toml").read_text().splitlines(keepends=True)
    begin = next(k for k, line in enumerate(lines) if line.startswith("[recorder]"))
    end = next(k for k, line in enumerate(lines) if k > begin and line.startswith("# ["))
    path = folder / "skin.toml"
    text = "".join(lines[:begin] + lines[end:])
    assert text.count("[skins.palm]\n") == 1
    path.write_text(text.replace("[skins.palm]\n", f'[skins.palm]\nscan = "{scan}"\n'))
    return path


@contextlib.contextmanager
def serving(folder, *options):
    """`skin up` with the stub board in this runtime folder, once valid contact frames come; ended afterwards."""
    from protocol.sockets import NewestReader  # here: numpy's threads are still to be limited by who needs it first

    with open(folder / "log.txt", "wb") as log:
        command = [sys.executable, str(ROOT / "skin"), "up", *options]
        environment = {**os.environ, "EITSKIN_RUNTIME": str(folder)}
        process = subprocess.Popen(command, stdout=log, stderr=log, env=environment)
    try:
        reader = NewestReader("contact", "palm", f"ipc://{folder}/publisher.ipc")
        try:
            until(lambda: (frame := reader.recv(1.0)) is not None and frame.valid, process)
        except AssertionError as error:
            raise AssertionError((folder / "log.txt").read_text()) from error
        reader.close()
        yield process
    finally:
        end(process)


@pytest.fixture
def service(runtime):
    with serving(runtime) as process:
        yield process


@contextlib.contextmanager
def _shared(without, scan="full"):
    with pytest.MonkeyPatch.context() as patch, contextlib.contextmanager(_folder)(patch) as folder:
        with serving(folder, *(("--config", str(without_recorder(folder, scan))) if without else ())):
            yield folder


@pytest.fixture(scope="module")
def shared_service():
    """The whole service, one for all tests of a file; gives its runtime folder, which $EITSKIN_RUNTIME names."""
    with _shared(without=False) as folder:
        yield folder


@pytest.fixture(scope="module")
def service_that_nobody_hears(request):
    with _shared(without=True, scan=request.param) as folder:
        yield folder
