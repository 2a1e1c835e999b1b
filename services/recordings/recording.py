"""Recordings: MCAP files that hold frames exactly as they crossed the sockets.

One channel a topic (``raw/palm``), message encoding ``msgpack``, the msgpack map of a frame as its data: any MCAP tool
reads it. ``state/<skin>`` holds what the stages' state was, by process. Nothing stays in memory longer than `FLUSH_S`:
what a killed recorder loses. A file that ends anywhere is read up to its last whole chunk: `RecordingReader` never
needs the index at the end.
"""

from __future__ import annotations

import io
import struct
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, cast

from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Message, Metadata
from mcap.stream_reader import breakup_chunk
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from services.recordings.patient_file import PatientFile

FLUSH_S = 0.1
CHUNK_BYTES = 64 * 1024
PROFILE = "eitskin"
STATE_TOPIC = "state"

_RECORD_HEAD = struct.Struct("<BQ")


class RecordingError(ValueError):
    """A file that cannot be read as a recording, or cannot be written; the text says what was found and what to do."""


@dataclass(frozen=True, slots=True)
class Recorded:
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
        self._writer.add_message(self._channels[topic], log_time_ns, data, log_time_ns, sequence)
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
        self._oldest = None

    @property
    def full(self) -> str:
        """Why nothing can be written now, as the system says it; "" while all is well."""
        return self._file.full

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

    def __str__(self) -> str:
        parts = [f"cut short: the last {self.lost_bytes} bytes are not a whole chunk"] if self.truncated else []
        parts += [f"{self.bad_chunks} chunk(s) with a wrong checksum left out"] if self.bad_chunks else []
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
        try:
            with open(self.path, "rb") as file:
                head = file.read(len(MCAP0_MAGIC))
                if head == MCAP0_MAGIC:
                    self._read_metadata(file)
        except OSError as error:
            raise RecordingError(f"cannot read {self.path}: {error.strerror}") from None
        if head != MCAP0_MAGIC:
            what = "is empty" if not head else f"starts with {head[:8]!r}"
            raise RecordingError(f"{self.path} {what}: not a recording of `skin record` or `skin import` (MCAP)")

    def _read_metadata(self, file: io.BufferedReader) -> None:
        for opcode, body in _records(file, Damage()):
            if opcode == Opcode.METADATA:
                record = _parse(Metadata, body)
                if record is not None and record.name == PROFILE:
                    self.metadata = dict(record.metadata)
            elif opcode == Opcode.CHUNK:
                return

    def messages(self, topics: set[str] | None = None, start_s: float = 0.0) -> Iterator[Recorded]:
        """Messages in file order; of those topics only (names without the skin), from `start_s` after the first one."""
        self.damage = Damage()
        names: dict[int, str] = {}
        first_ns: int | None = None
        with open(self.path, "rb") as file:
            file.seek(len(MCAP0_MAGIC))
            for opcode, body in _records(file, self.damage):
                if opcode == Opcode.DATA_END:
                    return
                for record in self._contents(opcode, body):
                    if isinstance(record, Channel):
                        names[record.id] = record.topic
                        continue
                    first_ns = record.log_time if first_ns is None else first_ns
                    topic = names.get(record.channel_id)
                    if topic is None or record.log_time - first_ns < start_s * 1e9:
                        continue
                    if topics is None or topic.partition("/")[0] in topics:
                        yield Recorded(topic, record.log_time, record.data)

    def _contents(self, opcode: int, body: bytes) -> Iterator[Channel | Message]:
        """Channels and messages of one record of the file, which may be a chunk of them."""
        if opcode == Opcode.CHUNK:
            try:
                inner = breakup_chunk(_require(_parse(Chunk, body)), validate_crc=True)
            except Exception:  # zstandard, lz4, struct and the library each raise their own: all mean this chunk is bad
                self.damage.bad_chunks += 1
                return
            yield from (record for record in inner if isinstance(record, Channel | Message))
        elif opcode == Opcode.CHANNEL:
            channel = _parse(Channel, body)
            if channel is not None:
                yield channel
        elif opcode == Opcode.MESSAGE:
            message = _parse(Message, body)
            if message is not None:
                yield message


def _records(file: io.BufferedReader, damage: Damage) -> Iterator[tuple[int, bytes]]:
    """(opcode, body) of each whole record; what remains of a cut one goes to `damage`."""
    size = file.seek(0, io.SEEK_END)
    position = len(MCAP0_MAGIC)
    while position < size:
        file.seek(position)
        head = file.read(_RECORD_HEAD.size)
        opcode, length = _RECORD_HEAD.unpack(head) if len(head) == _RECORD_HEAD.size else (0, size)
        if opcode == 0 or length > size - position - _RECORD_HEAD.size:
            break
        body = file.read(length)
        yield opcode, body
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
        return kind.read(_stream(body), len(body)) if kind is Message else kind.read(_stream(body))
    except Exception:  # struct.error, EndOfFile, UnicodeDecodeError: a body that does not hold what its opcode says
        return None


def _require(chunk: Any) -> Chunk:
    if not isinstance(chunk, Chunk):
        raise RecordingError("not a chunk")
    return chunk
