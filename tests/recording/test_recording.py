"""Recordings that were cut, killed or damaged still give what was in them before."""

import os
import random
import signal
import struct
import subprocess
import sys
import textwrap
import time
import tracemalloc
from pathlib import Path

import pytest
from mcap.reader import make_reader
from mcap.stream_reader import lz4, zstandard

from services.recordings.recording import (
    FLUSH_S,
    MAX_RECORD,
    RecordedMessage,
    RecordingError,
    RecordingReader,
    RecordingWriter,
)

pytestmark = pytest.mark.live

ROOT = Path(__file__).resolve().parents[2]


def messages(n: int) -> list[RecordedMessage]:
    """Two topics, incompressible bodies of uneven length."""
    rng = random.Random(7)
    return [
        RecordedMessage(
            ("raw/palm", "contact/palm")[k % 2], 10**18 + k * 20_000_000, rng.randbytes(rng.randint(1, 900))
        )
        for k in range(n)
    ]


def write(path: Path, sent: list[RecordedMessage], per_chunk: int = 5) -> None:
    with RecordingWriter(path, {"version": "1"}) as writer:
        for k, message in enumerate(sent):
            writer.write(message.topic, message.data, message.log_time_ns)
            if k % per_chunk == per_chunk - 1:
                writer.flush()


def test_what_was_written_is_read(tmp_path: Path) -> None:
    sent = messages(40)
    write(tmp_path / "a.mcap", sent)
    reader = RecordingReader(tmp_path / "a.mcap")
    assert list(reader.messages()) == sent
    assert reader.metadata == {"version": "1"}
    assert not reader.damage.truncated and str(reader.damage) == "whole"


def test_the_library_s_own_indexed_reader_agrees(tmp_path: Path) -> None:
    sent = messages(40)
    write(tmp_path / "a.mcap", sent)
    with open(tmp_path / "a.mcap", "rb") as file:
        rows = [(c.topic, c.message_encoding, m.log_time, m.data) for _, c, m in make_reader(file).iter_messages()]
    assert rows == [(s.topic, "msgpack", s.log_time_ns, s.data) for s in sent]


def test_a_start_time_and_topics_select(tmp_path: Path) -> None:
    sent = messages(40)
    write(tmp_path / "a.mcap", sent)
    got = list(RecordingReader(tmp_path / "a.mcap").messages({"raw"}, start_s=0.3))
    assert got == [s for s in sent if s.topic == "raw/palm" and s.log_time_ns >= sent[0].log_time_ns + 300_000_000]


def test_truncated_at_200_random_offsets(tmp_path: Path) -> None:
    """Whatever the length: a prefix of the messages, at most one chunk short of what the cut leaves, no exception."""
    sent, whole, cut = messages(120), tmp_path / "whole.mcap", tmp_path / "cut.mcap"
    write(whole, sent)
    content = whole.read_bytes()
    rng = random.Random(11)
    seen = set()
    for offset in [rng.randrange(len(content)) for _ in range(200)]:
        cut.write_bytes(content[:offset])
        if offset < 8:
            with pytest.raises(RecordingError, match="not a recording"):
                RecordingReader(cut)
            continue
        reader = RecordingReader(cut)
        got = list(reader.messages())
        assert got == sent[: len(got)]
        assert reader.damage.truncated or len(got) == len(sent)
        missing = sum(len(s.data) for s in sent[len(got) : len(got) + 5])
        assert reader.damage.lost_bytes < missing + 800  # less than one chunk with its indexes
        seen.add(len(got))
    assert len(seen) > 15  # the cuts really fell all over the file


def test_a_damaged_chunk_is_left_out_and_said(tmp_path: Path) -> None:
    sent, path = messages(40), tmp_path / "a.mcap"
    write(path, sent)
    content = bytearray(path.read_bytes())
    at = content.index(sent[12].data)  # random bytes are stored as they are
    content[at] ^= 0xFF
    path.write_bytes(content)
    reader = RecordingReader(path)
    assert list(reader.messages()) == sent[:10] + sent[15:]
    assert reader.damage.bad_chunks == 1 and "wrong checksum" in str(reader.damage)


@pytest.mark.parametrize("content", [b"", b"PK\3\4 a zip file", b"\x89MCAP0\r"])
def test_other_files_are_refused_in_words(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "a.mcap").write_bytes(content)
    with pytest.raises(RecordingError, match="not a recording"):
        RecordingReader(tmp_path / "a.mcap")


def test_missing_file_and_no_overwriting(tmp_path: Path) -> None:
    with pytest.raises(RecordingError, match="cannot be read"):
        RecordingReader(tmp_path / "none.mcap")
    (tmp_path / "a.mcap").write_bytes(b"")
    with pytest.raises(RecordingError, match="overwrite"):
        RecordingWriter(tmp_path / "a.mcap")


def test_noise_after_the_magic_never_raises(tmp_path: Path) -> None:
    rng = random.Random(3)
    for k in range(200):
        path = tmp_path / f"{k}.mcap"
        head = bytes([rng.randint(1, 15)]) + rng.randint(0, 60).to_bytes(8, "little")
        path.write_bytes(b"\x89MCAP0\r\n" + head + rng.randbytes(80))
        list(RecordingReader(path).messages())


def test_kill_9_loses_at_most_six_tenths_of_a_second(tmp_path: Path) -> None:
    path = tmp_path / "killed.mcap"
    program = textwrap.dedent("""
        import sys, time
        from pathlib import Path
        from services.recordings.recording import RecordingWriter
        writer = RecordingWriter(Path(sys.argv[1]))
        for k in range(10**6):
            writer.write("raw/palm", bytes(500), time.time_ns())
            print(time.time_ns(), flush=True)
            time.sleep(0.005)
    """)
    process = subprocess.Popen([sys.executable, "-c", program, str(path)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    lines = [process.stdout.readline() for _ in range(150)]
    os.kill(process.pid, signal.SIGKILL)
    killed_ns = time.time_ns()
    rest = process.stdout.read()
    process.wait()
    last_sent = int((rest.split() or lines[-1:])[-1])
    got = list(RecordingReader(path).messages())
    assert got and last_sent - got[-1].log_time_ns < 0.6e9 and killed_ns - got[-1].log_time_ns < 0.9e9
    assert FLUSH_S < 0.6


def chunk(compression: str, declared: int, data: bytes, crc: int = 0) -> bytes:
    """A chunk record that declares what we like."""
    body = struct.pack("<QQQII", 0, 1, declared, crc, len(compression)) + compression.encode()
    body += struct.pack("<Q", len(data)) + data
    return struct.pack("<BQ", 6, len(body)) + body


def bomb(path: Path, *records: bytes) -> Path:
    path.write_bytes(b"\x89MCAP0\r\n" + b"".join(records))
    return path


def test_a_chunk_that_declares_too_much_is_left_out_and_said(tmp_path: Path) -> None:
    huge = zstandard.compress(bytes(MAX_RECORD + 1))
    reader = RecordingReader(bomb(tmp_path / "a.mcap", chunk("zstd", MAX_RECORD + 1, huge)))
    assert list(reader.messages()) == [] and reader.damage.too_large == 1 and "more than" in str(reader.damage)


@pytest.mark.parametrize("declared", [0, 100, 10**6])
@pytest.mark.parametrize("compression", ["zstd", "lz4", "", "brotli"])
def test_a_chunk_that_unpacks_to_something_else_is_damaged(tmp_path: Path, compression: str, declared: int) -> None:
    """Nothing is unpacked beyond what is declared, whatever the compressed stream says of itself."""
    data = bytes(2**22)
    packed = {"zstd": zstandard.compress(data), "lz4": lz4.compress(data)}.get(compression, data)
    path = bomb(tmp_path / "a.mcap", chunk(compression, declared, packed))
    tracemalloc.start()
    reader = RecordingReader(path)
    assert list(reader.messages()) == [] and reader.damage.bad_chunks == 1
    most = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert most < 3 * len(packed) + 2 * declared + 2**20


def test_a_file_of_many_such_chunks_is_refused_before_it_takes_long(tmp_path: Path) -> None:
    """Intact chunks of the right checksum, 200 kB in all, that unpack to gigabytes of tiny messages."""
    message = struct.pack("<BQHIQQ", 5, 22, 1, 0, 0, 0)
    data = message * (MAX_RECORD // len(message))
    one = chunk("zstd", len(data), zstandard.compress(data, 3))
    path = bomb(tmp_path / "a.mcap", *[one] * (200_000 // len(one)))
    assert path.stat().st_size <= 200_000
    with pytest.raises(RecordingError, match="unpack to more than"):
        list(RecordingReader(path).messages())


def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.mcap")
    for name, says in (("pipe.mcap", "a pipe"), (".", "a folder")):
        with pytest.raises(RecordingError, match=says):
            RecordingReader(tmp_path / name)


def test_a_sparse_file_takes_no_memory(tmp_path: Path) -> None:
    path = bomb(tmp_path / "a.mcap", struct.pack("<BQ", 6, 2**39))
    os.truncate(path, 2**39 + 1000)
    reader = RecordingReader(path)
    assert list(reader.messages()) == [] and reader.damage.too_large == 1
