"""Recordings: MCAP files that hold frames exactly as they crossed the sockets.

One channel a topic (``raw/palm``), message encoding ``msgpack``, the msgpack map of a frame as its data: any MCAP tool
reads it. ``state/<skin>`` holds what the stages' state was, by process. Nothing stays in memory longer than `FLUSH_S`,
so a killed recorder loses no more. A file that ends anywhere can be read up to its last whole chunk: `RecordingReader`
never needs the index at the end. A file may come from anybody, so the size of a chunk is checked before it is unpacked.
"""

from __future__ import annotations

import io
import struct
import time
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, BinaryIO, cast

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata
from mcap.stream_reader import lz4, zstandard  # type: ignore[attr-defined]  # what the library unpacks with
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from models.files import FileError, open_file
from protocol.errors import EitskinError
from services.recordings.patient_file import PatientFile

FLUSH_S = 0.5  # each scan in parts repeats most of the one before: a chunk of 0.1 s packs half as well
CHUNK_BYTES = 1024 * 1024
PROFILE = "eitskin"
STATE_TOPIC = "state"
MAX_FILE = 2**40
MAX_RECORD = 16 * 1024 * 1024
"""Bytes of a record of the file, and of what a chunk unpacks to: the largest message and more."""
RATIO, SMALL = 100, 16 * 1024 * 1024
"""All chunks together may unpack to SMALL bytes, or to RATIO times the file: measurements never pack so well."""

_RECORD_HEAD = struct.Struct("<BQ")
_MESSAGE_HEAD = struct.Struct("<HIQQ")  # channel, sequence, log time, publish time


class RecordingError(EitskinError, ValueError):
    """A file that cannot be read as a recording, or cannot be written; the text says what was found and what to do."""


@dataclass(frozen=True, slots=True)
class RecordedMessage:
    """One message: `topic` as on the wire without its NUL (``raw/palm``), Unix `log_time_ns`, msgpack map `data`."""

    topic: str
    log_time_ns: int
    data: bytes

    @property
    def wire(self) -> bytes:
        """The message as it crossed the socket."""
        return self.topic.encode() + b"\0" + self.data


class RecordingWriter:
    """Writes a recording; call `flush_if_due` at least every `FLUSH_S`, also when nothing arrives."""

    def __init__(self, path: Path, metadata: dict[str, str] | None = None, overwrite: bool = False) -> None:
        try:
            self._file = PatientFile(path, overwrite)
        except FileExistsError:
            raise RecordingError(f"{path} is there already: choose another name, or say --overwrite") from None
        except OSError as error:
            raise RecordingError(f"cannot write {path}: {error.strerror}") from None
        # What the library asks of a stream, a PatientFile has: write and tell.
        self._writer = Writer(cast(IO[bytes], self._file), chunk_size=CHUNK_BYTES, compression=CompressionType.ZSTD)
        # The library closes a chunk by its size only; this is the method it does that with.
        self._close_chunk: Callable[[], None] = getattr(self._writer, "_Writer__finalize_chunk")  # noqa: B009
        self._writer.start(profile=PROFILE)
        self._channels: dict[str, int] = {}
        self._sequence: dict[str, int] = {}
        self._oldest: float | None = None
        self._open = 0  # bytes of messages in the chunk that is not closed yet
        self.lost = 0
        """Messages that there was no room for."""
        if metadata:
            self._writer.add_metadata(PROFILE, metadata)
        self._file.flush()

    def write(self, topic: str, data: bytes, log_time_ns: int) -> None:
        """Takes one message; it is in the file (safe from a kill) after at most `FLUSH_S`. While the disk is full some
        megabytes are kept in memory; then messages are dropped, and counted in `lost`.
        """
        if not self._file.room:
            self.lost += 1
            self.flush_if_due()
            return
        if topic not in self._channels:
            name, _, skin = topic.partition("/")
            self._channels[topic] = self._writer.register_channel(topic, "msgpack", 0, {"topic": name, "skin": skin})
        sequence = self._sequence[topic] = self._sequence.get(topic, 0) + 1
        written = self._file.tell()
        self._writer.add_message(self._channels[topic], log_time_ns, data, log_time_ns, sequence)
        self._open = self._open + len(data) if self._file.tell() == written else 0
        if self._oldest is None:
            self._oldest = time.monotonic()
        self.flush_if_due()

    def flush_if_due(self) -> None:
        if self._oldest is not None and time.monotonic() - self._oldest >= FLUSH_S:
            self.flush()
        elif self._file.full:
            self._file.flush()

    def flush(self) -> None:
        """Closes the chunk and hands it to the operating system."""
        self._close_chunk()
        self._file.flush()
        self._oldest, self._open = None, 0

    @property
    def full(self) -> str:
        """Why nothing can be written now, as the system says it; "" while all is well."""
        return self._file.full

    @property
    def elsewhere(self) -> str:
        """ "" while the file is where it was made, else "deleted" or "moved"."""
        return self._file.elsewhere

    @property
    def bytes(self) -> int:
        """Size of the file, with what still waits to be written; what is not packed yet counts as it is."""
        return self._file.tell() + self._open

    @property
    def counts(self) -> dict[str, int]:
        """Messages taken so far, by topic."""
        return dict(self._sequence)

    def close(self) -> None:
        if not self._file.closed:
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._file.close()

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


@dataclass(slots=True)
class Damage:
    """What a reader had to leave out."""

    truncated: bool = False
    lost_bytes: int = 0
    bad_chunks: int = 0
    too_large: int = 0

    def __str__(self) -> str:
        last = f"the last {self.lost_bytes} bytes are not a whole chunk" if self.lost_bytes else "after a whole chunk"
        parts = [f"cut short: {last}"] if self.truncated else []
        parts += [f"{self.bad_chunks} chunk(s) with a wrong checksum left out"] if self.bad_chunks else []
        parts += [f"{self.too_large} record(s) of more than {MAX_RECORD} bytes left out"] if self.too_large else []
        return "; ".join(parts) or "whole"


@dataclass(slots=True)
class RecordingReader:
    """Reads a recording from its beginning, whole or cut short at any byte.

    Raises RecordingError where the file is missing or is no MCAP file. `damage` is complete once `messages` has run to
    its end.
    """

    path: Path
    metadata: dict[str, str] = field(default_factory=dict)
    damage: Damage = field(default_factory=Damage)

    def __post_init__(self) -> None:
        with self._open() as file:
            head = file.read(len(MCAP0_MAGIC))
            if head == MCAP0_MAGIC:
                self._read_metadata(file)
        if head != MCAP0_MAGIC:
            what = "is empty" if not head else f"starts with {head[:8]!r}"
            raise RecordingError(f"{self.path} {what}: not a recording of `skin record` or `skin import` (MCAP)")

    def _open(self) -> BinaryIO:
        try:
            return open_file(self.path, MAX_FILE)
        except FileError as why:
            raise RecordingError(str(why)) from None

    def _read_metadata(self, file: BinaryIO) -> None:
        for opcode, body in _records(file, Damage()):
            if opcode == Opcode.METADATA:
                record = _parse(Metadata, body)
                if record is not None and record.name == PROFILE:
                    self.metadata = dict(record.metadata)
            elif opcode == Opcode.CHUNK:
                return

    def messages(self, topics: set[str] | None = None, start_s: float = 0.0) -> Iterator[RecordedMessage]:
        """Messages in file order; of those topics only (names without the skin), from `start_s` after the first one.

        Raises RecordingError where the file unpacks to more than any recording does.
        """
        self.damage = Damage()
        names: dict[int, str] = {}
        first_ns: int | None = None
        with self._open() as file:
            size = file.seek(0, io.SEEK_END)
            left = max(SMALL, RATIO * size)
            for opcode, body in _records(file, self.damage):
                if opcode == Opcode.DATA_END:
                    return
                if opcode == Opcode.CHUNK:
                    chunk = _parse(Chunk, body)
                    if chunk is not None and chunk.uncompressed_size > MAX_RECORD:
                        self.damage.too_large += 1
                        continue
                    left -= chunk.uncompressed_size if chunk is not None else 0
                    if left < 0:
                        raise RecordingError(
                            f"{self.path}: its {size} bytes unpack to more than {max(SMALL, RATIO * size)}: "
                            "no recording of measurements does"
                        )
                    body = self._unpacked(chunk)
                for record in _contents(opcode, body):
                    if isinstance(record, Channel):
                        names[record.id] = record.topic
                        continue
                    channel, log_time_ns, data = record
                    first_ns = log_time_ns if first_ns is None else first_ns
                    topic = names.get(channel)
                    if topic is None or log_time_ns - first_ns < start_s * 1e9:
                        continue
                    if topics is None or topic.partition("/")[0] in topics:
                        yield RecordedMessage(topic, log_time_ns, data)

    def _unpacked(self, chunk: Chunk | None) -> bytes:
        """The records of a chunk; none where it is damaged."""
        data = _decompressed(chunk) if chunk is not None else None
        if data is None:
            self.damage.bad_chunks += 1
        return data or b""


def _decompressed(chunk: Chunk) -> bytes | None:
    """What a chunk holds; None where that is not what it declares. The compressed stream's own word for its size is
    never asked for.
    """
    size = chunk.uncompressed_size
    try:
        if chunk.compression == "zstd":
            with zstandard.ZstdDecompressor(max_window_size=MAX_RECORD).stream_reader(chunk.data) as stream:
                data = stream.read(size + 1)
        elif chunk.compression == "lz4":
            data = lz4.LZ4FrameDecompressor().decompress(chunk.data, max_length=size + 1)
        elif not chunk.compression:
            data = chunk.data
        else:
            return None
    except Exception:  # zstandard and lz4 each raise their own: all mean that this chunk is bad
        return None
    intact = len(data) == size and chunk.uncompressed_crc in (0, zlib.crc32(data))
    return bytes(data) if intact else None


def _contents(opcode: int, body: bytes) -> Iterator[Channel | tuple[int, int, bytes]]:
    """Channels, and (channel, log time, data) of messages: of one record of the file, or of those of a chunk."""
    if opcode == Opcode.MESSAGE:
        if len(body) >= _MESSAGE_HEAD.size:
            channel, _, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(body)
            yield channel, log_time_ns, body[_MESSAGE_HEAD.size :]
    elif opcode == Opcode.CHANNEL:
        record = _parse(Channel, body)
        if record is not None:
            yield record
    elif opcode == Opcode.CHUNK:
        at, end = 0, len(body)
        while at + _RECORD_HEAD.size <= end:
            inner, length = _RECORD_HEAD.unpack_from(body, at)
            at += _RECORD_HEAD.size
            if length > end - at:
                return
            if inner in (Opcode.CHANNEL, Opcode.MESSAGE):
                yield from _contents(inner, body[at : at + length])
            at += length


def _records(file: BinaryIO, damage: Damage) -> Iterator[tuple[int, bytes]]:
    """(opcode, body) of each whole record; what remains of a cut one goes to `damage`."""
    size = file.seek(0, io.SEEK_END)
    position = len(MCAP0_MAGIC)
    while position < size:
        file.seek(position)
        head = file.read(_RECORD_HEAD.size)
        opcode, length = _RECORD_HEAD.unpack(head) if len(head) == _RECORD_HEAD.size else (0, size)
        if opcode == 0 or length > size - position - _RECORD_HEAD.size:
            break
        if length > MAX_RECORD:
            damage.too_large += 1
        else:
            yield opcode, file.read(length)
        if opcode == Opcode.FOOTER:
            return
        position += _RECORD_HEAD.size + length
    damage.truncated = True
    damage.lost_bytes = size - position


def _stream(body: bytes) -> Any:
    from mcap.data_stream import ReadDataStream

    return ReadDataStream(io.BytesIO(body))


def _parse(kind: Any, body: bytes) -> Any:
    """One record, or None where its body does not hold one."""
    try:
        return kind.read(_stream(body))
    except Exception:  # struct.error, EndOfFile, UnicodeDecodeError: a body that does not hold what its opcode says
        return None
