"""Recordings that were cut, killed, damaged or made by others still give what was in them before."""

import os
import random
import re
import struct
import tracemalloc
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.stream_reader import lz4, zstandard

from protocol.frames import RawFrame, pack
from services.recordings.damage import Damage
from services.recordings.mcap_scan import MAX_RECORD, McapScan, inner_records
from services.recordings.recording import RecordedMessage, RecordingError, RecordingReader, RecordingWriter

MAGIC = b"\x89MCAP0\r\n"


def written(path: Path, n: int) -> list[RecordedMessage]:
    rng, sent = random.Random(7), []
    with RecordingWriter(path, {"version": "1"}) as writer:
        for k in range(n):
            topic, data = ("raw/palm", "contact/palm")[k % 2], rng.randbytes(rng.randint(1, 900))
            sent.append(RecordedMessage(topic, 10**18 + k * 20_000_000, data))
            writer.write(topic, data, sent[-1].log_time_ns)
            if k % 5 == 4:
                writer.flush()
    return sent


def test_what_was_written_is_read_by_us_and_by_the_librarys_own_reader(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sent, reader = written(path, 40), RecordingReader(path)
    assert list(reader.messages()) == sent and reader.metadata == {"version": "1"}
    assert not reader.damage.truncated and str(reader.damage) == "whole"
    with open(path, "rb") as file:
        rows = [(c.topic, c.message_encoding, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]
    assert rows == [(s.topic, "msgpack", s.log_time_ns, s.data) for s in sent]
    wanted = [s for s in sent if s.topic == "raw/palm" and s.log_time_ns >= sent[0].log_time_ns + 300_000_000]
    assert list(RecordingReader(path).messages({"raw"}, start_s=0.3)) == wanted
    with pytest.raises(RecordingError, match="overwrite"):
        RecordingWriter(path)


def test_cut_anywhere_it_gives_a_prefix_of_the_messages_at_most_one_chunk_short(tmp_path: Path) -> None:
    whole, cut, rng, seen = tmp_path / "whole.mcap", tmp_path / "cut.mcap", random.Random(11), set()
    sent, content = written(whole, 120), whole.read_bytes()
    for offset in (rng.randrange(8, len(content)) for _ in range(200)):
        cut.write_bytes(content[:offset])
        reader = RecordingReader(cut)
        got = list(reader.messages())
        assert got == sent[: len(got)] and (reader.damage.truncated or len(got) == len(sent)), offset
        missing = sum(len(s.data) for s in sent[len(got) : len(got) + 5])
        assert reader.damage.lost_bytes < missing + 1000 and not reader.damage.whole  # a chunk with its index
        seen.add(len(got))
    assert len(seen) > 15


def test_each_byte_of_a_small_file_may_be_wrong(tmp_path: Path) -> None:
    """At most the chunk that has it is lost, nothing is invented, and what is missing is counted."""
    path, sent = tmp_path / "a.mcap", [RecordedMessage(f"raw/{s}", k, bytes([k])) for k in range(3) for s in "ab"]
    with RecordingWriter(path, {"version": "1"}) as writer:
        for k, message in enumerate(sent):
            writer.write(message.topic, message.data, message.log_time_ns)
            if k % 2:
                writer.flush()
    content = path.read_bytes()
    for at in range(len(content)):
        path.write_bytes(content[:at] + bytes([content[at] ^ (1 << at % 8)]) + content[at + 1 :])
        reader = RecordingReader(path)
        got = list(reader.messages())
        lost = len(sent) - len(got)
        assert lost in (0, 2) and [m for m in sent if m in got] == got and reader.metadata == {"version": "1"}, at
        assert reader.damage.missing.total() == lost and not (lost and reader.damage.whole), at


def raws(path: Path, first: int, chunks: int) -> tuple[bytes, list[int]]:
    """A recording with one scan a chunk, and where each chunk begins."""
    at = []
    with RecordingWriter(path, {"version": "1"}) as writer:
        for scan in range(first, first + chunks):
            at.append(path.stat().st_size)
            frame = RawFrame(skin="palm", scan=scan, z=np.full(20, scan, "c8"), status=np.zeros(20, "u1"))
            writer.write("raw/palm", pack(frame).partition(b"\0")[2], scan)
            writer.flush()
    return path.read_bytes(), at


@pytest.mark.parametrize(
    ("what", "left", "says"),
    [
        ("magic", "0123456789", "8 bytes damaged in 1 place(s), the first at byte 0; no message is missing"),
        ("first chunk", "123456789", "1 message(s) cannot be read: raw/palm 1 (up to scan 100)"),
        ("chunks 3, 4 and 7", "01256 89", "3 message(s) cannot be read: raw/palm 3 (scans 103 to 104, scan 107)"),
        ("last chunk", "012345678", "1 message(s) cannot be read: raw/palm 1 (after scan 108)"),
        ("first chunk, cut", "12345", "cut short: it has no end; .*at least 1 message(s) cannot be read"),
        ("end", "0123456789", "its index is damaged; how many messages are missing is not known"),
        ("zeros behind", "0123456789", "5000 bytes zeros in 1 place(s), the first at byte .*; no message is missing"),
        ("zeros from 6 on", "012345", "cut short: it has no end; .* bytes damaged in 1 place"),
        ("joined", "01234567890123456789", "2 recordings joined$"),
        ("cut, joined", "0123450123456789", "2 recordings joined; cut short"),
    ],
)
def test_what_is_left_is_read_and_the_rest_counted(tmp_path: Path, what: str, left: str, says: str) -> None:
    path = tmp_path / "a.mcap"
    content, at = raws(path, 100, 10)
    spoilt = bytearray(content)
    places = {"magic": [0], "first chunk": [at[0]], "last chunk": [at[9]], "first chunk, cut": [at[0]]}
    places |= {"chunks 3, 4 and 7": [at[3], at[4], at[7]], "end": [content.rindex(b"\x0b") + 20]}
    for place in places.get(what, []):
        inside = place + (150 if place in at else 0)
        spoilt[inside : inside + 8] = bytes(byte ^ 0x5A for byte in spoilt[inside : inside + 8])
    whole, cut = bytes(spoilt), bytes(spoilt[: at[6] + 30])
    longer = {"first chunk, cut": cut, "zeros behind": whole + bytes(5000), "zeros from 6 on": cut[:-30] + bytes(4096)}
    path.write_bytes((longer | {"joined": whole * 2, "cut, joined": cut + whole}).get(what, whole))
    reader = RecordingReader(path)
    assert "".join(str(m.log_time_ns % 10) for m in reader.messages()) == left.replace(" ", "")
    assert re.search(says.replace("(", r"\(").replace(")", r"\)"), str(reader.damage)), str(reader.damage)
    assert reader.metadata == {"version": "1"} and reader.damage.whole == (what == "joined")


def test_without_channels_topics_are_known_by_fields_and_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    content, _ = raws(path, 0, 1)
    body = inner_records(next(r.body for r in McapScan(path.open("rb"), Damage()).records() if r.kind == 6))
    path.write_bytes(MAGIC + b"".join(struct.pack("<BQ", kind, len(b)) + b for kind, b in body if kind == 5))
    assert [message.topic for message in RecordingReader(path).messages()] == ["raw/palm"]
    for content in (b"", b"PK\3\4 a zip file", MAGIC[:-1]):
        path.write_bytes(content)
        with pytest.raises(RecordingError, match="not a recording"):
            RecordingReader(path)


def chunk(compression: str, declared: int, data: bytes) -> bytes:
    body = struct.pack("<QQQII", 0, 1, declared, 0, len(compression)) + compression.encode()
    body += struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", 6, len(body)) + body


def made(path: Path, *records: bytes) -> Path:
    path.write_bytes(MAGIC + b"".join(records))
    return path


def test_a_chunk_that_declares_too_much_is_left_out_and_said(tmp_path: Path) -> None:
    sparse = made(tmp_path / "b.mcap", struct.pack("<BQ", 6, 2**39))
    os.truncate(sparse, 2**39 + 1000)  # and takes no memory
    huge = zstandard.compress(bytes(MAX_RECORD + 1))
    for path, says in ((made(tmp_path / "a.mcap", chunk("zstd", MAX_RECORD + 1, huge)), "more"), (sparse, "zeros")):
        reader = RecordingReader(path)
        assert list(reader.messages()) == [] and says in str(reader.damage)


@pytest.mark.parametrize("declared", [0, 100, 10**6])
@pytest.mark.parametrize("compression", ["zstd", "lz4", "", "brotli"])
def test_a_chunk_that_unpacks_to_something_else_is_damaged(tmp_path: Path, compression: str, declared: int) -> None:
    """Nothing is unpacked beyond what is declared, whatever the compressed stream says of itself."""
    data = bytes(2**22)
    packed = {"zstd": zstandard.compress(data), "lz4": lz4.compress(data)}.get(compression, data)
    reader = RecordingReader(made(tmp_path / "a.mcap", chunk(compression, declared, packed)))
    tracemalloc.start()
    assert list(reader.messages()) == [] and reader.damage.bad_chunks == 1
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 3 * len(packed) + 2 * declared + 2**20


def test_200_kb_of_intact_chunks_that_unpack_to_gigabytes_of_messages_are_refused(tmp_path: Path) -> None:
    message = struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0)
    data = message * (MAX_RECORD // len(message))
    one = chunk("zstd", len(data), zstandard.compress(data, 3))
    with pytest.raises(RecordingError, match="unpack to more than"):
        list(RecordingReader(made(tmp_path / "a.mcap", *[one] * (200_000 // len(one)))).messages())
