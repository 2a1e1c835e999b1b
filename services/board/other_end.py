"""What is at the other end of a port where no board introduces itself, named by what it sends.

Each sentence says what was found, quotes its first bytes, and says what to do.
"""

from __future__ import annotations

import re
import zlib
from collections import Counter
from collections.abc import Iterator

from protocol import link
from protocol.cobs import cobs_decode
from protocol.link_messages import BY_NUMBER
from protocol.part_size import BAUD

FIRST_BYTES = 16384  # first bytes of a connection that are looked at: three of the longest scans
QUOTED = 60
ENOUGH = 16  # bytes to quote
GLITCH = 8  # fewer bytes of 0 or 255 come of a plug that is put in
TEXT = 0.9  # share of printable bytes from which bytes are text
SLOWER = 0.8  # share of bytes whose bits change once at most: of other lines than slower ones 6 % do
OURS = 0.6  # share of pieces that begin as a board's message: of random ones 3 % do
HELLO = link.encode(link.Hello(schema_hash=link.SCHEMA_HASH)).strip(b"\0")
RFC2217 = "rfc2217://"
NETWORK = ("socket://", RFC2217)

OTHER = "is it the board's? Correct `port` in skin.toml"
TELNET = rb"\xff[\xfb-\xfe]."  # what its two ends settle first
BUSY = rb"in use|busy|already|locked|too many|maximum|exceed|occupied|denied|refused|not available"
SERVERS = (  # of a network: what it is, by which bytes, what to do
    ("a web server (HTTP)", rb"\AHTTP/|(?i:<html)", OTHER),
    ("an SSH server", rb"\ASSH-", OTHER),
    ("a mail or file server", rb"\A(220[ -]|\+OK|\* OK)", OTHER),
    ("a server that speaks TLS", rb"\A[\x15\x16]\x03", OTHER),
    ("a ZeroMQ socket", rb"\A\xff.{8}\x7f", OTHER),
    ("a busy gateway", rb"(?i)\A([^\n]*\n){0,2}[^\n]*?(" + BUSY + rb")", "close the other connection to it"),
    ("a telnet server", rb"\A" + TELNET, "give its raw port, or write rfc2217:// where it speaks that"),
)
DEVICES = (
    ("a satellite receiver (NMEA)", rb"[$!](P[A-Z]{3}|[A-Z]{5})\w*,[^\r\n]*,", OTHER),
    ("a console that asks for a login", rb"(?i)login:|password:", OTHER),
    ("a boot loader", rb"ets [A-Z][a-z]{2} |rst:0x|ESP-ROM|U-Boot", "flash the board's firmware"),
    ("a Python prompt", rb"MicroPython|CircuitPython|>>> ", "flash the board's firmware"),
    ("a machine that takes G-code", rb"(?i)marlin|grbl", OTHER),
)


class OtherEnd:
    """The other end of one connection to `url`, until a board has said who it is."""

    def __init__(self, url: str = "this port", baud: int = BAUD) -> None:
        self.url, self.baud = url, baud
        self._received = b""
        self._kinds: Counter[type[link.Message]] = Counter()  # of the messages that were whole
        self._quoted = b""  # of the first bytes: it stays as it is, so that the same thing is said once
        self._named: tuple[int, str, str] = (-1, "", "")  # of so many bytes: what they are, and what to do

    @property
    def answered(self) -> bool:
        """Whether anything was said, beside what comes of a plug that is put in."""
        return len(self._received) >= GLITCH or bool(self._received.strip(b"\0\xff"))

    def receive(self, data: bytes, messages: list[link.Message]) -> None:
        self._received += data[: FIRST_BYTES - len(self._received)]
        self._kinds.update(map(type, messages))

    def sentence(self, and_then: str = "") -> str:
        """What answers instead of a board, for a person, and what it did then."""
        if not self.answered:
            return f"no board at {self.url}: {self._silent()}"
        if len(self._quoted) < ENOUGH:
            self._quoted = self._received
        if self._named[0] != len(self._received):
            self._named = len(self._received), *self._name()
        _, found, advice = self._named
        return f"no board at {self.url}: {found}{and_then}: {advice}"

    def closed(self, why: str) -> str:
        """The same where the connection is lost, for which the port has a reason of its own."""
        if self.answered:
            return self.sentence(and_then=f", and {'closes the connection' if self._network else 'is gone'}")
        if self._network:
            return (
                f"no board at {self.url}: the connection is closed without a word: a gateway does so while another "
                "program uses its port; close that one"
            )
        return why

    @property
    def _network(self) -> bool:
        return self.url.lower().startswith(NETWORK)

    def _silent(self) -> str:
        if self._network:
            return "the connection is taken and nothing is said: is a board wired to that gateway, and powered?"
        return "no answer to HELLO, and nothing else comes: is the board powered, and is its firmware running?"

    def _name(self) -> tuple[str, str]:
        """What the bytes are, and what to do."""
        if link.Hello in self._kinds or HELLO in self._received:
            return "our own HELLO comes back", "take the loopback plug away, or mend wires that touch"
        if self._kinds:
            return "it sends a board's messages and does not answer HELLO", "look at the wire from here to the board"
        if schema := self._other_schema():
            ours = link.SCHEMA_HASH
            return f"frames of schema {schema:08x}, this program speaks {ours:08x}", "flash a matching firmware"
        pieces = [piece for piece in self._received.split(b"\0") if len(piece) > 5]
        like_ours = sum(piece[1] in BY_NUMBER and piece[1] > 0x80 for piece in pieces)
        if len(pieces) > 2 and like_ours > OURS * len(pieces):
            return "a board's frames, none of them whole", "bytes are lost on the way; look at cable and hub"
        return self._foreign()

    def _foreign(self) -> tuple[str, str]:
        for what, pattern, advice in (*SERVERS, *DEVICES) if self._network else DEVICES:
            if found := re.search(pattern, self._received, re.DOTALL):
                line = self._received[self._received.rfind(b"\n", 0, found.end()) + 1 :]
                return f"found {what}, which sends {quoted(re.sub(TELNET, b'', line) or line)}", advice
        first_bytes = quoted(self._quoted)
        if text_share(self._received) >= TEXT:
            return f"found text, {first_bytes}", "is it the board's port, and has the board its firmware?"
        if not self._received.strip(b"\0\xff"):
            return (
                f"found nothing but bytes of 0 or 255, {first_bytes}",
                "is the board powered, and its wire connected?",
            )
        if sum(map(_runs, self._received)) > SLOWER * max(ENOUGH, len(self._received)):
            what = f"found bytes as from a line slower than our {self.baud} baud, {first_bytes}"
            return what, "set `baud` in skin.toml to the board's"
        what = f"found bytes that are neither text nor a board's, {first_bytes}"
        return what, f"is `baud` ({self.baud}) the board's, and is it the board's port?"

    def _other_schema(self) -> int:
        """The hash of the schema by which two different frames have right checksums; 0 where there is none."""
        seeds = Counter(_seed(body, crc) for body, crc in set(_frames(self._received)))
        schema, times = max(seeds.items(), key=lambda each: each[1], default=(0, 0))
        return schema if times > 1 else 0


def quoted(data: bytes) -> str:
    """The first bytes, or the first line of them, printable, at most QUOTED characters."""
    line = data.strip().splitlines()[0] if text_share(data) >= TEXT and data.strip() else data
    shown = ""
    for byte in line[: QUOTED + 1]:
        shown += chr(byte) if 32 <= byte < 127 and byte not in b'"\\' else f"\\x{byte:02x}"
    return f'"{shown}"' if len(shown) <= QUOTED else f'"{shown[: QUOTED - 3]}..."'


def printable(text: str) -> str:
    """What a board says of itself, for a terminal."""
    return "".join(char if char.isprintable() else f"\\x{ord(char):02x}" for char in text)


def text_share(data: bytes) -> float:
    """Share of the characters that a text has."""
    good = sum(char.isprintable() or char in "\r\n\t" for char in data.decode("utf-8", errors="ignore"))
    return good / max(1, len(data.decode("utf-8", errors="replace")))


def _runs(byte: int) -> bool:
    """Whether a byte's bits change once at most."""
    return (byte ^ byte >> 1) & 0x7F in (0, 1, 2, 4, 8, 16, 32, 64)


def _frames(data: bytes) -> Iterator[tuple[bytes, int]]:
    """Bodies and checksums of what may be messages of a board of any schema."""
    for piece in data.split(b"\0")[:-1]:
        try:
            checked = cobs_decode(piece)
        except ValueError:
            continue
        kind = BY_NUMBER.get(checked[0]) if len(checked) > 8 else None
        if kind is not None and not kind.plain_crc:
            yield checked[:-4], int.from_bytes(checked[-4:], "little")


def _seed(body: bytes, crc: int) -> int:
    """The start from which a body has this CRC-32: the checksum goes back through as many zeros as the body has
    bytes, since what the body itself adds is known.
    """
    state = crc ^ zlib.crc32(body)
    for _ in range(8 * len(body)):
        state = (state ^ 0xEDB88320) << 1 | 1 if state & 0x80000000 else state << 1
    return state
