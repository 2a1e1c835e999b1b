"""The records of an MCAP file, whole or damaged at any byte.

A record is a byte that says its kind, eight that say its length, and its content. It is believed where another record,
or the end, follows it, or where its content confirms it; elsewhere the scan goes on at the next place that looks like a
record. What a chunk holds is taken where its checksum confirms it, whatever is wrong around it. A file may come from
anybody, so the size of a chunk is checked before it is unpacked.
"""

from __future__ import annotations

import io
import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import Any, BinaryIO, NamedTuple

from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.opcode import Opcode
from mcap.records import Channel, Header, Metadata, Statistics
from mcap.stream_reader import lz4, zstandard  # type: ignore[attr-defined]  # what the library unpacks with
from mcap.writer import MCAP0_MAGIC

from services.recordings.damage import Damage

MAX_RECORD = 16 * 1024 * 1024
"""Bytes of a record of the file, and of what a chunk unpacks to: the largest message and more."""
RATIO, SMALL = 100, 16 * 1024 * 1024
"""All chunks together may unpack to SMALL bytes, or to RATIO times the file: measurements never pack so well."""
WINDOW = 1024 * 1024
END = 0
"""The kind that stands for the mark with which a file begins and ends."""

_HEAD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")  # first and last time, size, checksum, length of the compression's name
_LEAST = {kind: 16 for kind in Opcode} | {Opcode.HEADER: 8, Opcode.MESSAGE: 22, Opcode.CHUNK: 40}
_LEAST |= {Opcode.MESSAGE_INDEX: 6, Opcode.SCHEMA: 14, Opcode.METADATA: 8, Opcode.FOOTER: 20, Opcode.DATA_END: 4}
_EXACT = {Opcode.FOOTER: 20, Opcode.DATA_END: 4}
_KINDS = {Opcode.HEADER: Header, Opcode.METADATA: Metadata, Opcode.CHANNEL: Channel, Opcode.STATISTICS: Statistics}
_LIKE_A_HEAD = re.compile(rb"(?=([\x01-\x0f].{3}[\x00\x01]\x00{4}))", re.DOTALL)
_ZSTD, _LZ4 = b"\x28\xb5\x2f\xfd", b"\x04\x22\x4d\x18"


Unpack = Callable[[bytes, int], bytes | None]
"""Of compressed bytes so many, at most."""


class ScannedRecord(NamedTuple):
    """A record that is believed: where it begins, its kind (END for a mark), and what it holds; a chunk's unpacked."""

    at: int
    kind: int
    body: bytes


class McapScan:
    """Gives the records of `file` in order, and counts in `damage` what belongs to none."""

    def __init__(self, file: BinaryIO, damage: Damage, unpack: bool = True, most: int = 2**63) -> None:
        """unpack: else chunks are given empty, unread. most: bytes of the file to scan."""
        self._file, self._fd, self.damage, self._unpack = file, file.fileno(), damage, unpack
        self.size = min(most, file.seek(0, io.SEEK_END))
        self.most = max(SMALL, RATIO * self.size)
        self.left = self.most
        """Bytes that chunks may still unpack to; below 0 the scan has stopped."""

    def skim(self) -> McapScan:
        """Another scan of the same file, that passes over chunks."""
        return McapScan(self._file, Damage(), unpack=False)

    def read(self, at: int, count: int) -> bytes:
        """Bytes of the file, fewer at its end. What the medium does not give any more is 0."""
        try:
            return os.pread(self._fd, max(0, min(count, self.size - at)), at)
        except OSError as why:
            self.damage.medium = os.strerror(why.errno or 0)
            return bytes(min(count, self.size - at))

    def records(self, at: int = 0) -> Iterator[ScannedRecord]:
        """From `at` on."""
        while at < self.size and self.left >= 0:
            if self.read(at, len(MCAP0_MAGIC)) == MCAP0_MAGIC:
                yield ScannedRecord(at, END, b"")
                at += len(MCAP0_MAGIC)
                continue
            found, end = self._record(at)
            if found is not None:
                yield found
            if end > at:
                if at == 0:  # its mark is gone, and nothing else
                    self.damage.lose(0, 0)
                at = end
                continue
            end = self._next(at + 1)
            rest = self.read(at, min(end - at, WINDOW))
            self.damage.lose(at, end, rest.count(0) == len(rest))
            at = end

    def _head(self, at: int) -> tuple[int, int] | None:
        """Kind and length of a record that may begin there."""
        head = self.read(at, _HEAD.size)
        if len(head) < _HEAD.size:
            return None
        kind, length = _HEAD.unpack(head)
        if not Opcode.HEADER <= kind <= Opcode.DATA_END or length > min(MAX_RECORD, self.size - at - _HEAD.size):
            return None
        return (kind, length) if _LEAST[kind] <= length <= _EXACT.get(kind, length) else None

    def _follows(self, at: int) -> bool:
        """Whether a record, or the end, is there."""
        return at == self.size or self._head(at) is not None or self.read(at, len(MCAP0_MAGIC)) == MCAP0_MAGIC

    def _record(self, at: int) -> tuple[ScannedRecord | None, int]:
        """The record at a place, and where the next one begins; `at` where this is not known."""
        head = self.read(at, _HEAD.size + _CHUNK.size + 16)
        if len(head) < _HEAD.size:
            return None, at
        kind, length = _HEAD.unpack_from(head)
        known = self._head(at)
        body, sound = head[_HEAD.size :], known is not None and self._follows(at + _HEAD.size + known[1])
        end = at + _HEAD.size + length
        if kind == Opcode.CHUNK or _is_chunk(body, length):
            if not self._unpack:
                return (ScannedRecord(at, kind, b""), end) if sound else (None, at)
            found, last = self._chunk(at, body, end, sound)
            if found is not None and (kind != Opcode.CHUNK or last != end):  # its head alone is damaged
                self.damage.lose(at, at)
            return found, last
        return (None, at) if known is None else self._plain(at, kind, length, sound)

    def _plain(self, at: int, kind: int, length: int, sound: bool) -> tuple[ScannedRecord | None, int]:
        """A record that is no chunk; sound: another one follows it."""
        end = at + _HEAD.size + length
        body = self.read(at + _HEAD.size, length)
        for named in (kind, Opcode.METADATA):  # which may have lost its kind, and with it what a replay needs
            if named in _KINDS and parsed(named, body) is not None:
                return ScannedRecord(at, named, body), end
        if not sound:
            return None, at
        if kind in _KINDS:
            self.damage.lose(at, end)
            return None, end
        return ScannedRecord(at, kind, body), end

    def _chunk(self, at: int, head: bytes, end: int, sound: bool) -> tuple[ScannedRecord | None, int]:
        """A chunk by what it says of itself: its length stands there twice, its data begin with their compression."""
        if len(head) < _CHUNK.size + 16:
            return None, at
        _, _, size, checksum, name = _CHUNK.unpack_from(head)
        packs: tuple[tuple[int, bytes, Unpack], ...] = ((4, _ZSTD, _unzstd), (3, _LZ4, _unlz4))
        found = [(n, unpack) for n, mark, unpack in packs if head[_CHUNK.size + n + 8 :][:4] == mark]
        skip, unpack = found[0] if found else (0, _as_is)
        if not found and name:  # compressed by something else, or damaged there
            skip, unpack = min(name, 8), _nothing
        begin = at + _HEAD.size + _CHUNK.size + skip + 8
        (length,) = struct.unpack_from("<Q", head, _CHUNK.size + skip)
        for last in dict.fromkeys((begin + length, end)):
            if begin <= last <= min(self.size, begin + MAX_RECORD):
                data = self._unpacked(self.read(begin, last - begin), size, checksum, unpack)
                if data is not None:
                    return ScannedRecord(at, Opcode.CHUNK, data), last
        if sound:
            self.damage.too_large += size > MAX_RECORD
            self.damage.bad_chunks += size <= MAX_RECORD
        return None, end if sound else at

    def _unpacked(self, packed: bytes, size: int, checksum: int, unpack: Unpack) -> bytes | None:
        """What a chunk holds; None where neither its size nor its checksum confirms it. The compressed stream's own
        word for its size is never asked for.
        """
        for most in (size, MAX_RECORD) if checksum else (size,):
            if most > MAX_RECORD:
                continue
            try:
                data = unpack(packed, most + 1)
            except Exception:  # zstandard and lz4 each raise their own: all mean that this chunk is bad
                data = None
            self.left -= len(packed) + len(data or b"")
            if data is None or self.left < 0:
                return None
            if zlib.crc32(data) == checksum if checksum else len(data) == size:
                return data
        return None

    def _next(self, at: int) -> int:
        """Where the next record begins, from `at` on; the file's size where there is none."""
        while at < self.size:
            try:
                at = os.lseek(self._fd, at, os.SEEK_DATA)  # a hole holds nothing
            except OSError:
                return self.size
            window = self.read(at, WINDOW + 64)
            mark = window.find(MCAP0_MAGIC)
            for found in _LIKE_A_HEAD.finditer(window, 0, len(window) if mark < 0 else mark):
                if found.start() < WINDOW and self._is_record(at + found.start(), window[found.start() :][:64]):
                    return at + found.start()
            if mark >= 0:
                return at + mark
            at += WINDOW
        return self.size

    def _is_record(self, at: int, head: bytes) -> bool:
        known = self._head(at)
        if known is None:
            return False
        return _is_chunk(head[_HEAD.size :], known[1]) or self._follows(at + _HEAD.size + known[1])


def _is_chunk(body: bytes, length: int) -> bool:
    """Whether the beginning of a record's content is that of a compressed chunk of this length."""
    for name in (b"zstd", b"lz4"):
        at = _CHUNK.size + len(name)
        if body[_CHUNK.size - 4 : at] == struct.pack("<I", len(name)) + name and len(body) >= at + 8:
            return bool(at + 8 + struct.unpack_from("<Q", body, at)[0] == length)
    return False


def _unzstd(packed: bytes, most: int) -> bytes:
    with zstandard.ZstdDecompressor(max_window_size=MAX_RECORD).stream_reader(packed) as stream:
        return bytes(stream.read(most))


def _unlz4(packed: bytes, most: int) -> bytes:
    return bytes(lz4.LZ4FrameDecompressor().decompress(packed, max_length=most))


def _as_is(packed: bytes, most: int) -> bytes:
    return packed


def _nothing(packed: bytes, most: int) -> None:
    return None


def parsed(kind: int, body: bytes) -> Any:
    """The record; None where the content does not hold just that."""
    try:
        found = _KINDS[Opcode(kind)].read(ReadDataStream(io.BytesIO(body)))  # type: ignore[attr-defined]
        found.write(again := RecordBuilder())
        same = again.end()[_HEAD.size :] == body  # type: ignore[no-untyped-call]
        return found if same else None
    except Exception:  # struct.error, EndOfFile, UnicodeDecodeError: a body that does not hold what its opcode says
        return None


def inner_records(data: bytes) -> Iterator[tuple[int, bytes]]:
    """(kind, content) of the records in a chunk."""
    at, end = 0, len(data)
    while at + _HEAD.size <= end:
        kind, length = _HEAD.unpack_from(data, at)
        at += _HEAD.size
        if length > end - at:
            return
        yield kind, data[at : at + length]
        at += length
