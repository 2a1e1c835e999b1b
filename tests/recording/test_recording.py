"""Recordings that were cut, killed, damaged or made by others still give what was in them before."""

import os
import random
import struct
import tracemalloc
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import lz4, zstandard

from services.recordings.recording import MAX_RECORD, RecordedMessage, RecordingError, RecordingReader, RecordingWriter

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
        assert got == sent[: len(got)] and (reader.damage.truncated or len(got) == len(sent))
        missing = sum(len(s.data) for s in sent[len(got) : len(got) + 5])
        assert reader.damage.lost_bytes < missing + 800  # less than one chunk with its indexes
        seen.add(len(got))
    assert len(seen) > 15


def test_a_damaged_chunk_is_left_out_and_said_and_what_is_no_recording_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    sent, content = written(path, 40), bytearray(path.read_bytes())
    content[content.index(sent[12].data)] ^= 0xFF  # random bytes are stored as they are
    path.write_bytes(content)
    reader = RecordingReader(path)
    assert list(reader.messages()) == sent[:10] + sent[15:]
    assert reader.damage.bad_chunks == 1 and "wrong checksum" in str(reader.damage)
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
    for path in (made(tmp_path / "a.mcap", chunk("zstd", MAX_RECORD + 1, huge)), sparse):
        reader = RecordingReader(path)
        assert list(reader.messages()) == [] and reader.damage.too_large == 1 and "more than" in str(reader.damage)


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
