"""`skin info`: what is in a recording."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest

from protocol.frames import Contact, ContactFrame, Frame, StatusFrame, pack
from services.recordings.recording import RecordingWriter
from services.recordings.summary import Course, strip, summarise
from tests import needs
from tests.cli.conftest import Ran, skin  # noqa: F401

Skin = Callable[..., Ran]
EVERY_S = 0.05


def contact(k: int) -> ContactFrame:
    """Frame k of 200, 0.05 s apart: a touch from 2 to 4 s that grows to 4 N, an open electrode from 5 to 6 s."""
    pressed = 40 <= k < 80
    touch = Contact(id=3, position=[0.01, 0.02, 0.0], force_n=(k - 39) * 0.1)
    reasons = ["electrode_open"] if 100 <= k < 120 else ["changing"] if k == 40 else []
    valid = not 110 <= k < 120
    return ContactFrame(skin="palm", valid=valid, reasons=reasons, contacts=[touch] if pressed else [], seq=k)


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    """The frames above, those of 7 to 8 s missing, and one that is no frame; acquisition fails at 7 s."""
    path = tmp_path / "session.mcap"

    def put(writer: RecordingWriter, frame: Frame, at_s: float) -> None:
        topic, _, data = pack(frame).partition(b"\0")
        writer.write(topic.decode(), data, int((1_700_000_000 + at_s) * 1e9))

    with RecordingWriter(path, {"origin": "snapshot", "event": "fault: palm: acquisition ERROR"}) as writer:
        for k in range(200):
            if not 140 <= k < 160:
                put(writer, contact(k), k * EVERY_S)
            if k in (138, 158, 178):
                level = "OK" if k == 178 else "ERROR"
                said = StatusFrame(skin="palm", process="acquisition", level=level, messages=[f"unplugged for {k} s"])
                put(writer, said, k * EVERY_S)
        writer.write("contact/palm", b"rubbish", int(1_700_000_010 * 1e9))
    return path


def test_topics_gaps_faults_and_contacts_are_found(recording: Path) -> None:
    found = summarise(recording)
    topic = found.topics["contact/palm"]
    assert (topic.messages, topic.malformed, topic.missing) == (181, 1, 20)
    assert topic.rate_hz == pytest.approx(20, rel=1e-3) and found.duration_s == pytest.approx(10.0)
    assert topic.gaps() == [(pytest.approx(6.95), pytest.approx(1.05))]
    said = {(f.what, round(f.begin_s, 2), round(f.end_s, 2)) for f in found.faults}
    assert said == {("electrode_open", 5.0, 5.95), ("acquisition ERROR: unplugged for 138 s", 6.9, 7.9)}
    (touch,) = found.contacts
    assert (touch.what, touch.most_n, touch.place) == ("3", pytest.approx(4.0), (0.01, 0.02, 0.0))
    assert (touch.begin_s, touch.end_s) == (pytest.approx(2.0), pytest.approx(3.95))


def test_it_is_told_in_text_and_as_json(skin: Skin, recording: Path) -> None:  # noqa: F811
    told = skin("info", recording).out
    assert "a snapshot: fault: palm: acquisition ERROR" in told and "10.0 s from 2023-11-14 22:13:20 UTC" in told
    assert "contacts: 1\n" in told and "gaps: 1\n" in told
    assert "palm 3: up to 4.00 N at +10.0, +20.0 mm" in told and "1 malformed" in told
    assert "contact/palm: nothing for 1.05 s" in told and "palm: electrode_open" in told
    force, valid = told.split("where not valid\n")[1].splitlines()[:2]
    assert "█" in force and "✕" in valid and "─" in valid
    plain = json.loads(skin("info", recording, "--json").out)
    assert plain["contacts"][0] == {
        "skin": "palm",
        "id": 3,
        "begin_s": pytest.approx(2.0),
        "end_s": pytest.approx(3.95),
        "most_n": pytest.approx(4.0),
        "position_m": [0.01, 0.02, 0.0],
    }
    assert plain["gaps"][0]["topic"] == "contact/palm" and plain["damage"] == "whole"


def test_a_file_that_was_cut_is_told_as_far_as_it_goes(
    skin: Skin,  # noqa: F811
    recording: Path,
    tmp_path: Path,
) -> None:
    recording.write_bytes(recording.read_bytes()[:-3000])
    ran = skin("info", recording)
    assert ran.code == 0 and "cut short" in ran.out
    with RecordingWriter(tmp_path / "killed.mcap") as writer:
        writer.write("contact/palm", pack(contact(0)).partition(b"\0")[2], 10**18)
        writer.flush()
        (tmp_path / "copy.mcap").write_bytes((tmp_path / "killed.mcap").read_bytes())
    assert summarise(tmp_path / "copy.mcap").damage == "cut short: after a whole chunk"
    recording.write_bytes(b"")
    assert "is empty" in (ran := skin("info", recording)).err and ran.code == 2


def test_a_picture_on_request(skin: Skin, recording: Path, tmp_path: Path) -> None:  # noqa: F811
    needs.PLOTS.here()
    assert skin("info", recording, "--png", tmp_path / "a.png").code == 0
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG") and (tmp_path / "a.png").stat().st_size > 10_000
    assert "cannot write" in skin("info", recording, "--png", tmp_path / "none" / "a.png").err


def test_the_strip_shows_the_most_force_of_each_column_and_any_frame_that_was_not_valid() -> None:
    course = Course([0.0, 1.0, 1.5, 3.0], [0.0, 8.0, 1.0, 4.0], [True, True, False, True])
    force, valid, most = strip(course, 4.0, 4)
    assert (force, valid, most) == (" █ ▅", "─✕ ─", 8.0)
