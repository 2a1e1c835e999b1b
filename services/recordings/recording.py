"""Recordings: MCAP files that hold frames exactly as they crossed the sockets.

One channel a topic (``raw/palm``), message encoding ``msgpack``, the msgpack map of a frame as its data: any MCAP tool
reads it. ``state/<skin>`` holds what the stages' state was, by process. Nothing stays in memory longer than `FLUSH_S`,
so a killed recorder loses no more. `RecordingReader` reads what is left of a damaged one, and counts what is not.
"""

from __future__ import annotations

import contextlib
import struct
import time
import zlib
from collections import Counter, deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import IO, BinaryIO, cast

from mcap._chunk_builder import ChunkBuilder
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, DataEnd, Footer, Metadata
from mcap.writer import MCAP0_MAGIC, CompressionType, Writer

from models.files import FileError, open_file
from protocol.errors import EitskinError
from protocol.frames import FrameError, read_map, unpack
from protocol.topics import TOPICS
from services.recordings.damage import Damage, MissingMessages
from services.recordings.mcap_scan import END, WINDOW, McapScan, ScannedRecord, inner_records, parsed
from services.recordings.patient_file import PatientFile

FLUSH_S = 0.5  # each scan in parts repeats most of the one before: a chunk of 0.1 s packs half as well
CHUNK_BYTES = 1024 * 1024
MOST_UNPACKED = 2**62  # never reached: the library is to close no chunk by itself
MOST_CUT = 16  # chunks that may go so that a file on a full disk has an end
PROFILE = "eitskin"
UNWRITTEN = "eitskin unwritten"
"""Metadata of a file that lacks messages: how many of each topic there was no room for."""
CHECKSUM = "checksum"
STATE_TOPIC = "state"
MAX_FILE = 2**40
LOOKED_AT = 64 * 1024 * 1024
"""Bytes of a file without MCAP's mark in which a record is looked for."""
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
    """Writes a recording; call `flush_if_due` at least every `FLUSH_S`, also when nothing arrives.

    Nothing that goes wrong with the medium raises: `full` says it while it lasts, `why` afterwards, and `unwritten`
    counts the messages that are not in the file.
    """

    def __init__(self, path: Path, metadata: dict[str, str] | None = None, overwrite: bool = False) -> None:
        """overwrite: the file that is there stays until a message is in the new one. Raises RecordingError."""
        try:
            self._file = PatientFile(path, overwrite)
        except FileExistsError:
            raise RecordingError(f"{path} is there already: choose another name, or say --overwrite") from None
        except OSError as error:
            raise RecordingError(f"cannot write {path}: {error.strerror}") from None
        # What the library asks of a stream, a PatientFile has: write and tell.
        stream = cast(IO[bytes], self._file)
        self._writer = Writer(stream, chunk_size=MOST_UNPACKED, compression=CompressionType.ZSTD)
        # The library closes a chunk by its size only, and describes a channel in the first one only.
        self._end_of_chunk: Callable[[], None] = getattr(self._writer, "_Writer__finalize_chunk")  # noqa: B009
        self._chunk: ChunkBuilder = getattr(self._writer, "_Writer__chunk_builder")  # noqa: B009
        self._channels: dict[str, Channel] = {}
        self._sequence: Counter[str] = Counter()
        self._oldest: float | None = None
        self._open: Counter[str] = Counter()  # messages of the chunk that is not closed yet
        self._chunks: deque[tuple[int, Counter[str]]] = deque()  # where the last ones end, and what they hold
        self.unwritten: Counter[str] = Counter()
        """Messages by topic that are not in the file: there was no room for them, or the medium failed."""
        self.why = ""
        """What stood in the way, as the system says it."""
        self._metadata = {**metadata, CHECKSUM: checksum_of(metadata)} if metadata else {}
        self._writer.start(profile=PROFILE)
        if metadata:
            self._writer.add_metadata(PROFILE, self._metadata)
        self._begin = self._file.tell()
        self._file.flush()
        if overwrite and self.full:
            self._file.close()
            self._file.remove()
            raise RecordingError(f"cannot write {path}: {self.full}; what was there stays")

    def write(self, topic: str, data: bytes, log_time_ns: int) -> None:
        """Takes one message; it is in the file (safe from a kill) after at most `FLUSH_S`. While nothing can be written
        some megabytes are kept in memory; then messages are dropped, and counted in `unwritten`.
        """
        if not self._file.room:
            self.unwritten[topic] += 1
            self.why = self.full
            self.flush_if_due()
            return
        if topic not in self._channels:
            name, _, skin = topic.partition("/")
            said = {"topic": name, "skin": skin}
            number = self._writer.register_channel(topic, "msgpack", 0, said)
            self._channels[topic] = Channel(number, topic, "msgpack", said, 0)
        self._sequence[topic] += 1
        self._open[topic] += 1
        number, sequence = self._channels[topic].id, self._sequence[topic]
        self._writer.add_message(number, log_time_ns, data, log_time_ns, sequence)
        if self._oldest is None:
            self._oldest = time.monotonic()
        if self._chunk.count > CHUNK_BYTES:
            self._close_chunk()
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
        if self._chunks and self._chunks[0][0] <= self._file.written:
            self._file.replace()
        self._oldest = None
        self.why = self.full or self.why

    def _close_chunk(self) -> None:
        """Each chunk describes its channels, so that it can be read without those before it."""
        if not self._open:
            return
        self._end_of_chunk()
        self._chunks.append((self._file.tell(), self._open))
        self._open = Counter()
        while len(self._chunks) > MOST_CUT and self._chunks[-MOST_CUT][0] <= self._file.written:
            self._chunks.popleft()
        for channel in self._channels.values():
            self._chunk.add_channel(channel)

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
        return self._file.tell() + (self._chunk.count if self._open else 0)

    @property
    def lost(self) -> int:
        """Messages that are not in the file."""
        return self.unwritten.total()

    @property
    def counts(self) -> dict[str, int]:
        """Messages by topic that are in the file, or still wait to be written."""
        return dict(self._sequence)

    def close(self) -> None:
        """Ends the file, which is whole then: what could not be written is cut off, and the file says how much. Without
        a message no file is left.
        """
        if self._file.closed:
            return
        self._close_chunk()
        if self.unwritten:
            self._writer.add_metadata(UNWRITTEN, self._unwritten())
        if self._metadata:
            self._writer.add_metadata(PROFILE, self._metadata)  # again, lest a damaged beginning lose it
        self._writer.finish()  # type: ignore[no-untyped-call]
        self._file.flush(now=True)
        self.why = self.full or self.why
        if self.full:
            self._cut_back()
        if self._sequence:
            self._file.replace()
        else:
            self._file.remove()
        self._file.close()
        self.why = self.full or self.why

    def _cut_back(self) -> None:
        """Leave out the last chunks, as many as must go so that the rest has an end."""
        while self._chunks and self._chunks[-1][0] > self._file.written:
            self._leave_out(self._chunks.pop())
        for _ in range(MOST_CUT):
            end = self._chunks[-1][0] if self._chunks else self._begin
            try:
                if end <= self._file.written and self._file.ends_with(end, _ending(self._unwritten())):
                    return
            except OSError:  # it can be neither written nor cut
                return
            if not self._chunks:
                return self._file.remove()
            self._leave_out(self._chunks.pop())

    def _leave_out(self, chunk: tuple[int, Counter[str]]) -> None:
        self.unwritten += chunk[1]
        self._sequence -= chunk[1]

    def _unwritten(self) -> dict[str, str]:
        return {topic: str(count) for topic, count in self.unwritten.items()}

    def __enter__(self) -> RecordingWriter:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _ending(unwritten: dict[str, str]) -> bytes:
    """The shortest end of a file, which says what is not in it."""
    builder = RecordBuilder()
    for record in (Metadata(UNWRITTEN, unwritten), DataEnd(0), Footer(0, 0, 0)):
        record.write(builder)
    return bytes(builder.end()) + MCAP0_MAGIC  # type: ignore[no-untyped-call]


@dataclass(slots=True)
class RecordingReader:
    """Reads a recording from its beginning, whole or damaged at any byte.

    Raises RecordingError where the file is missing or holds no record of MCAP. `damage` is complete once `messages` has
    run to its end.
    """

    path: Path
    metadata: dict[str, str] = field(default_factory=dict)
    damage: Damage = field(default_factory=Damage)

    def __post_init__(self) -> None:
        with self._open() as file:
            head = file.read(len(MCAP0_MAGIC))
            known = head == MCAP0_MAGIC
            for record in McapScan(file, Damage(), unpack=False, most=MAX_FILE if known else LOOKED_AT).records():
                known = known or record.kind != END
                said = _own_metadata(record.body) if record.kind == Opcode.METADATA else {}
                if said.pop(CHECKSUM, None) == checksum_of(said) and known:
                    self.metadata = said
                    break
                self.metadata = self.metadata or said  # older files have no checksum
        if not known:
            what = "is empty" if not head else f"starts with {head[:8]!r}"
            raise RecordingError(f"{self.path} {what}: not a recording of `skin record` or `skin import` (MCAP)")

    def _open(self) -> BinaryIO:
        try:
            return open_file(self.path, MAX_FILE)
        except FileError as why:
            raise RecordingError(str(why)) from None

    def messages(self, topics: set[str] | None = None, start_s: float = 0.0) -> Iterator[RecordedMessage]:
        """Messages in file order; of those topics only (names without the skin), from `start_s` after the first one.

        Raises RecordingError where the file unpacks to more than any recording does.
        """
        self.damage = Damage()
        first_ns: int | None = None
        with self._open() as file:
            scan = McapScan(file, self.damage)
            for message in _MessageReading(scan).messages():
                first_ns = message.log_time_ns if first_ns is None else first_ns
                if start_s and message.log_time_ns - first_ns < start_s * 1e9:
                    continue
                if topics is None or message.topic.partition("/")[0] in topics:
                    yield message
            if scan.left < 0:
                raise RecordingError(
                    f"{self.path}: its {scan.size} bytes unpack to more than {scan.most}: "
                    "no recording of measurements does"
                )


class _MessageReading:
    """The state of one read through, of one recording or of several that were joined."""

    def __init__(self, scan: McapScan) -> None:
        self.scan, self.damage = scan, scan.damage
        self._seen: set[tuple[int, int]] = set()  # checksum and length of each chunk
        self._begin()

    def _begin(self) -> None:
        self._index = 0  # where the index begins
        self._chunked = False
        self._topics: dict[int, str] = {}
        self._said: dict[int, int] | None = None  # messages of each channel, as the file's own statistics say
        self._ended = self._confirmed = False
        self._missing = MissingMessages(self.damage)

    def messages(self) -> Iterator[RecordedMessage]:
        for record in self.scan.records():
            if record.kind == Opcode.CHUNK:
                self._chunked = True
                known = zlib.crc32(record.body), len(record.body)  # and with them the time and number of each message
                again = known in self._seen
                self._seen.add(known)
                self.damage.repeated += again
                for kind, body in inner_records(record.body):
                    yield from self._contents(record.at, kind, body, again)
            elif record.kind == Opcode.CHANNEL or (record.kind == Opcode.MESSAGE and not self._chunked):
                yield from self._contents(record.at, record.kind, record.body)
            else:
                self._note(record)
        self._end()

    def _note(self, record: ScannedRecord) -> None:
        """What says something of the file."""
        if record.kind == Opcode.HEADER and (self._missing.seen or self._ended):
            self._end()
            self.damage.recordings += 1
            self._begin()
        elif record.kind == Opcode.METADATA:
            found = parsed(Opcode.METADATA, record.body)
            if found is not None and found.name == UNWRITTEN:
                self.damage.unwritten += Counter({k: int(n) for k, n in found.metadata.items() if n.isdecimal()})
        elif record.kind == Opcode.STATISTICS:
            self._said = parsed(Opcode.STATISTICS, record.body).channel_message_counts
        elif record.kind == Opcode.DATA_END:
            self._index = record.at + 9 + len(record.body)
        elif record.kind == Opcode.FOOTER:
            self._ended, self._confirmed = True, self._index_is_intact(record)

    def _index_is_intact(self, footer: ScannedRecord) -> bool:
        """Whether what stands between data and footer is as it was written."""
        (checksum,) = struct.unpack_from("<I", footer.body, 16)
        begin, end = self._index, footer.at + 9 + 16  # what the footer says of places is wrong in a joined file
        if not checksum:
            return self._said is None
        found = 0
        for at in range(begin, end, WINDOW):
            found = zlib.crc32(self.scan.read(at, min(WINDOW, end - at)), found)
        return begin < end and found == int(checksum)

    def _end(self) -> None:
        """The recording ends: what does it say that is not there?"""
        if self._confirmed and self._said is not None:
            self._missing.end({self._topics.get(key, f"channel {key}"): n for key, n in self._said.items()})
        self.damage.truncated |= not self._ended
        self.damage.index |= self._ended and not self._confirmed
        self.damage.confirmed &= self._confirmed

    def _contents(self, at: int, kind: int, body: bytes, again: bool = False) -> Iterator[RecordedMessage]:
        """Messages, where they have not been given before; channels are noted. at: of the record of the file."""
        if kind == Opcode.CHANNEL:
            if (channel := parsed(Opcode.CHANNEL, body)) is not None:
                self._topics[channel.id] = channel.topic
        elif kind == Opcode.MESSAGE and len(body) >= _MESSAGE_HEAD.size:
            key, sequence, log_time_ns, _ = _MESSAGE_HEAD.unpack_from(body)
            data = body[_MESSAGE_HEAD.size :]
            if key not in self._topics:
                self._topics = {key: _topic_of(data)} | self._topics_at_the_end(at) | self._topics
            topic = self._topics[key]
            if not topic:
                self.damage.nameless += 1
                return
            self._missing.take(topic, sequence, data, again)
            if not again:
                yield RecordedMessage(topic, log_time_ns, data)

    def _topics_at_the_end(self, at: int) -> dict[int, str]:
        """The channels that are repeated in the index: those of the first chunk, where this is lost."""
        found: dict[int, str] = {}
        for record in self.scan.skim().records(at):
            if record.kind == Opcode.HEADER:
                break
            if record.kind == Opcode.CHANNEL:
                channel = parsed(Opcode.CHANNEL, record.body)
                found[channel.id] = channel.topic
        return found


def _own_metadata(body: bytes) -> dict[str, str]:
    """What a recording says of itself; {} where it is damaged, or somebody else's."""
    found = parsed(Opcode.METADATA, body)
    if found is None or found.name != PROFILE:
        return {}
    said = dict(found.metadata)
    checksum = said.pop(CHECKSUM, "")
    if checksum not in ("", checksum_of(said)):
        return {}
    return said | ({CHECKSUM: checksum} if checksum else {})


def checksum_of(said: dict[str, str]) -> str:
    """Of metadata, for which MCAP has none."""
    return f"{zlib.crc32(repr(sorted(said.items())).encode()):08x}"


def _topic_of(data: bytes) -> str:
    """The topic of a message whose channel is lost, by its fields; "" where it is none of ours."""
    try:
        keys = read_map(data, "message")
    except FrameError:
        return ""
    skin = keys.get("skin")
    near = sorted(TOPICS, key=lambda name: len(keys.keys() ^ {f.name for f in fields(TOPICS[name].frame)}))
    for topic in (f"{name}/{skin}" for name in near[:3]):
        with contextlib.suppress(FrameError, UnicodeEncodeError):
            unpack(f"{topic}\0".encode() + data)
            return topic
    return ""
