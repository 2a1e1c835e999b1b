"""What others write is logged as one short line, and no place in the program floods the log."""

import io
import logging

import pytest

from protocol import logs
from protocol.logs import foreign
from protocol.sockets import NewestReader, Publisher

from .test_sockets import until

pytestmark = pytest.mark.live


@pytest.fixture
def log(monkeypatch):
    """A process's log; gives a function that returns the lines since the last call."""
    root, stream = logging.getLogger(), io.StringIO()
    before, level = root.handlers[:], root.level
    root.handlers.clear()
    with monkeypatch.context() as patch:
        patch.setattr("sys.stderr", stream)
        logs.setup("here: %(message)s")

    def lines():
        text = stream.getvalue()
        stream.seek(0)
        stream.truncate()
        return text.splitlines()

    yield lines
    root.handlers[:], root.level = before, level


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("plain, with umlauts: ä", "plain, with umlauts: ä"),
        ("two\nlines\x1b[31m red\r", r"two\nlines\x1b[31m red\r"),
        (b"\xff\x00bytes", r"\xff\x00bytes"),
        ("right\u202eto left", r"right\u202eto left"),
        (ValueError("an error"), "an error"),
    ],
)
def test_foreign_text_is_one_line_without_control_characters(text, line):
    assert foreign(text) == line


def test_foreign_text_is_cut(log):
    for text in ("x" * 10**6, "\0" * 10**6, b"\xff" * 10**6):
        assert len(foreign(text)) == logs.TEXT and foreign(text).endswith("...")
    logging.getLogger("t").warning("%s", "y" * 10**6)
    assert max(map(len, log())) <= logs.LINE + len("here: ")


def test_one_place_writes_so_many_lines_and_then_says_how_many_it_kept_back(log, monkeypatch):
    now = 0.0
    monkeypatch.setattr("protocol.logs.time.monotonic", lambda: now)

    def hostile(number):
        logging.getLogger("t").warning("message\n%d", number)

    for number in range(1000):
        hostile(number)
    lines = log()
    assert len(lines) <= 2 * logs.BURST and lines[0] == "here: message"
    logging.getLogger("t").warning("another place")
    assert log() == ["here: another place"]
    now = logs.EVERY_S + 1
    hostile(1)
    assert f"{1000 - logs.BURST} more like it" in " ".join(log())


def test_a_traceback_is_kept_and_bounded(log):
    try:
        raise RuntimeError("deep " * 10_000)
    except RuntimeError:
        logging.getLogger("t").exception("failed")
    text = "\n".join(log())
    assert "Traceback" in text and len(text) <= logs.LINE + 100


@pytest.mark.release
def test_a_peer_that_sends_rubbish_cannot_fill_the_log(runtime, context, log):
    publisher = Publisher("publisher", context)
    reader = NewestReader("contact", "palm", context=context)
    until(lambda: publisher.poll() or publisher.wanted("contact", "palm"))
    for number in range(300):
        publisher.socket.send(b"contact/palm\0\x81\xa7\x1b[2Jx%03d\x01" % number)
        reader.recv(0.02)
    lines = log()
    assert reader.malformed > 50, lines
    assert 0 < len(lines) < 30 and not any("\x1b" in line for line in lines)
    publisher.close()
