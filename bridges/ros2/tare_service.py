"""The service /eitskin/SKIN/tare (std_srvs/Trigger), for ROS 2 clients on Fast DDS: an RTPS participant of its own.

It announces itself, tells whoever answers of its endpoints, takes requests and answers each by name: a reply carries
the identity of its request. Reliable both ways. Only with `commands = true`: anybody in the ROS domain may call it.
"""

from __future__ import annotations

import logging
import os
import select
import socket
import struct
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field

from . import rtps
from .rtps import Address

REQUEST_TYPE, RESPONSE_TYPE = "std_srvs::srv::dds_::Trigger_Request_", "std_srvs::srv::dds_::Trigger_Response_"
ANNOUNCE_S, HEARTBEAT_S, LEASE_S = 1.0, 0.5, 10
GROUP = "239.255.0.1"
PEERS = 16  # participants on this host that are looked for, one by one, where there is no multicast
MOST_PEERS = 256
MOST_WRITERS, MOST_NUMBERS = 64, 1024  # of one peer: writers, and numbers of samples that have come
KEPT = 16  # replies that can be sent again
AT_ONCE = 4  # requests that wait; further ones are refused

log = logging.getLogger(__name__)
Act = Callable[[], tuple[bool, str]]


@dataclass
class Peer:
    """Another participant."""

    metatraffic: list[Address]
    user: list[Address]
    seen: float
    lease_s: float = LEASE_S
    received: dict[tuple[bytes, bytes], set[int]] = field(default_factory=dict)  # by (writer, our reader)

    def known(self, writer: bytes, ours: bytes) -> set[int]:
        """The numbers of the samples of its writer that have come to our reader. It may make up as many as it likes."""
        found = self.received.setdefault((writer, ours), set())
        if len(self.received) > MOST_WRITERS:
            del self.received[next(iter(self.received))]
        if len(found) > MOST_NUMBERS:
            found -= set(sorted(found)[: MOST_NUMBERS // 2])
        return found


@dataclass
class OwnWriter:
    """One of our writers: what it sent, for who asks again."""

    reader: bytes  # whom it speaks to; UNKNOWN: whoever listens
    samples: deque[tuple[int, bytes, bytes]]  # number, payload, inline
    last: int = 0

    def add(self, payload: bytes, inline: bytes = b"") -> int:
        self.last += 1
        self.samples.append((self.last, payload, inline))
        return self.last


class TareService:
    """All skins' services; a thread of its own. `acts`: base of the topics -> what a call does."""

    def __init__(self, domain: int, interface: str, acts: dict[str, Act]) -> None:
        self._prefix = rtps.VENDOR + os.urandom(10)
        self._domain, self._here = domain, interface == "lo"
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1" if self._here else "0.0.0.0", 0))
        if not self._here:
            self._socket.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_TTL, 1)
        self.port: int = self._socket.getsockname()[1]
        self._peers: dict[bytes, Peer] = {}
        self._writers = {
            rtps.PUBLICATIONS: OwnWriter(rtps.PUBLICATIONS_READER, deque()),
            rtps.SUBSCRIPTIONS: OwnWriter(rtps.SUBSCRIPTIONS_READER, deque()),
        }
        self._acts: dict[bytes, tuple[bytes, Act]] = {}  # our reader -> our writer, what to do
        for k, (base, act) in enumerate(acts.items(), 1):
            reader, writer = struct.pack(">HBB", 0, k, 0x04), struct.pack(">HBB", 0, k, 0x03)
            self._acts[reader] = writer, act
            self._writers[writer] = OwnWriter(rtps.UNKNOWN, deque(maxlen=KEPT))
            name = base.lstrip("/")
            told = self._endpoint(reader, f"rq/{name}/tareRequest", REQUEST_TYPE)
            self._writers[rtps.SUBSCRIPTIONS].add(told)
            self._writers[rtps.PUBLICATIONS].add(self._endpoint(writer, f"rr/{name}/tareReply", RESPONSE_TYPE))
        self._count, self._stop = 0, False
        self._waiting = threading.Semaphore(AT_ONCE)
        self._answers: deque[tuple[bytes, bytes, bytes, bool, str]] = deque()
        self._thread = threading.Thread(target=self._run, name="tare service", daemon=True)
        self._thread.start()

    # what we say of ourselves

    def _addresses(self) -> list[Address]:
        if self._here:
            return [("127.0.0.1", self.port)]
        return [(host, self.port) for host in dict.fromkeys((_own_address(), "127.0.0.1"))]

    def _about(self) -> bytes:
        locators = [rtps.locator(address) for address in self._addresses()]
        return rtps.PL_CDR + rtps.parameter_list(
            [
                (rtps.PROTOCOL, b"\x02\x03"),
                (rtps.VENDOR_ID, rtps.VENDOR),
                (rtps.PARTICIPANT_GUID, self._prefix + rtps.PARTICIPANT),
                *((rtps.METATRAFFIC_LOCATOR, each) for each in locators),
                *((rtps.DEFAULT_LOCATOR, each) for each in locators),
                (rtps.LEASE, struct.pack("<iI", LEASE_S, 0)),
                (rtps.BUILTIN_ENDPOINTS, struct.pack("<I", 0x3F)),
            ]
        )

    def _endpoint(self, entity: bytes, topic: str, kind: str) -> bytes:
        return rtps.PL_CDR + rtps.parameter_list(
            [
                (rtps.ENDPOINT_GUID, self._prefix + entity),
                (rtps.PARTICIPANT_GUID, self._prefix + rtps.PARTICIPANT),
                (rtps.PROTOCOL, b"\x02\x03"),
                (rtps.VENDOR_ID, rtps.VENDOR),
                (rtps.TOPIC, rtps.text(topic)),
                (rtps.TYPE, rtps.text(kind)),
                (rtps.RELIABILITY, struct.pack("<IiI", 2, 0, 1 << 29)),
                (rtps.DURABILITY, struct.pack("<I", 0)),
            ]
        )

    def _announce(self) -> None:
        said = rtps.message(self._prefix, [rtps.data(rtps.SPDP_READER, rtps.SPDP_WRITER, 1, self._about())])
        base = 7400 + 250 * self._domain
        self._send(said, [("127.0.0.1", base + 10 + 2 * k) for k in range(PEERS)])
        if not self._here:
            self._send(said, [(GROUP, base)])
        for peer in self._peers.values():
            self._send(said, peer.metatraffic)

    def _send(self, said: bytes, to: list[Address]) -> None:
        for address in to:
            try:
                self._socket.sendto(said, address)
            except OSError as why:  # nobody there, or no such network
                log.debug("not sent to %s: %s", address, why)

    # the loop

    def _run(self) -> None:
        next_announce = next_heartbeat = 0.0
        while not self._stop:
            now = time.monotonic()
            if now >= next_announce:
                next_announce = now + ANNOUNCE_S
                self._peers = {p: peer for p, peer in self._peers.items() if now - peer.seen < peer.lease_s}
                self._announce()
            if now >= next_heartbeat:
                next_heartbeat = now + HEARTBEAT_S
                for prefix in self._peers:
                    self._heartbeats(prefix)
            if select.select([self._socket], [], [], 0.05)[0]:
                self._receive()
            while self._answers:
                self._reply(*self._answers.popleft())

    def _receive(self) -> None:
        try:
            raw = self._socket.recv(65536)
            prefix, subs = rtps.parse(raw)
            if prefix == self._prefix:
                return
            for each in subs:
                if each.to in (bytes(12), self._prefix):
                    self._take(prefix, each)
        except (OSError, rtps.Malformed, struct.error) as why:
            log.debug("dropped a message: %s", why)

    def _take(self, prefix: bytes, each: rtps.Sub) -> None:
        if each.kind == rtps.DATA:
            self._data(prefix, rtps.read_data(each))
            return
        reader, writer = each.body[:4], each.body[4:8]
        peer = self._peers.get(prefix)
        if peer is None:
            return
        if each.kind == rtps.HEARTBEAT and len(each.body) >= 28:
            first, last = rtps.number_at(each.body, 8), rtps.number_at(each.body, 16)
            self._acknowledge(prefix, peer, writer, reader, first, last)
        elif each.kind == rtps.GAP and len(each.body) >= 28:
            start, (base, irrelevant) = rtps.number_at(each.body, 8), rtps.number_set(each.body, 16)
            for ours in self._readers_of(writer, reader):
                known = peer.known(writer, ours)
                known.update(range(max(start, base - rtps.MOST_BITS), base))
                known.update(irrelevant)
        elif each.kind == rtps.ACKNACK and writer in self._writers:
            _, missing = rtps.number_set(each.body, 8)
            self._again(prefix, peer, writer, set(missing))

    def _readers_of(self, writer: bytes, reader: bytes) -> list[bytes]:
        """Our readers that a submessage is for."""
        builtin = {rtps.PUBLICATIONS: rtps.PUBLICATIONS_READER, rtps.SUBSCRIPTIONS: rtps.SUBSCRIPTIONS_READER}
        if writer in builtin:
            return [builtin[writer]]
        return [reader] if reader in self._acts else list(self._acts) if len(self._acts) == 1 else []

    def _acknowledge(self, prefix: bytes, peer: Peer, writer: bytes, reader: bytes, first: int, last: int) -> None:
        """Say what has come of what there is, and so ask for the rest."""
        for ours in self._readers_of(writer, reader):
            known = peer.known(writer, ours)
            known -= {n for n in known if not first <= n <= last}
            missing = [n for n in range(first, min(last, first + rtps.MOST_BITS) + 1) if n not in known]
            base = missing[0] if missing else last + 1
            self._count += 1
            to = peer.metatraffic if writer[3] == 0xC2 else peer.user
            self._send(rtps.message(self._prefix, [rtps.acknack(ours, writer, base, missing, self._count)], prefix), to)

    def _heartbeats(self, prefix: bytes) -> None:
        peer = self._peers[prefix]
        for name, writer in self._writers.items():
            if not writer.samples:
                continue
            self._count += 1
            beat = rtps.heartbeat(writer.reader, name, writer.samples[0][0], writer.last, self._count)
            to = peer.metatraffic if name[3] == 0xC2 else peer.user
            self._send(rtps.message(self._prefix, [beat], prefix), to)

    def _again(self, prefix: bytes, peer: Peer, name: bytes, numbers: set[int]) -> None:
        """Send these again."""
        writer = self._writers[name]
        to = peer.metatraffic if name[3] == 0xC2 else peer.user
        for number, payload, inline in writer.samples:
            if number in numbers:
                said = rtps.data(writer.reader, name, number, payload, inline)
                self._send(rtps.message(self._prefix, [said], prefix), to)

    def _data(self, prefix: bytes, found: rtps.Arrived) -> None:
        if found.writer == rtps.SPDP_WRITER:
            self._discover(prefix, found)
            return
        peer = self._peers.get(prefix)
        if peer is None:
            return
        for ours in self._readers_of(found.writer, found.reader):
            known = peer.known(found.writer, ours)
            if found.number in known:
                continue
            known.add(found.number)
            if ours in self._acts and found.payload:
                self._request(prefix, ours, found)

    def _discover(self, prefix: bytes, found: rtps.Arrived) -> None:
        """A participant announces itself, or says that it leaves."""
        if not found.payload:
            self._peers.pop(prefix, None)
            return
        told, _ = rtps.parameters(found.payload, 4)
        metatraffic = rtps.addresses(told.get(rtps.METATRAFFIC_LOCATOR, []))
        user = rtps.addresses(told.get(rtps.DEFAULT_LOCATOR, [])) or metatraffic
        lease = told.get(rtps.LEASE, [b""])[0]
        lease_s = float(struct.unpack_from("<i", lease)[0]) if len(lease) >= 4 else LEASE_S
        known = self._peers.get(prefix)
        if known is not None:
            known.seen, known.metatraffic, known.user = time.monotonic(), metatraffic, user
        elif metatraffic and len(self._peers) < MOST_PEERS:
            self._peers[prefix] = Peer(metatraffic, user, time.monotonic(), min(max(lease_s, 1.0), 120.0))
            self._announce()
            self._heartbeats(prefix)
            for writer, reader in (
                (rtps.PUBLICATIONS, rtps.PUBLICATIONS_READER),
                (rtps.SUBSCRIPTIONS, rtps.SUBSCRIPTIONS_READER),
            ):
                self._count += 1
                said = rtps.acknack(reader, writer, 1, [], self._count)
                self._send(rtps.message(self._prefix, [said], prefix), metatraffic)
                self._again(prefix, self._peers[prefix], writer, set(range(1, self._writers[writer].last + 1)))

    # requests

    def _request(self, prefix: bytes, ours: bytes, found: rtps.Arrived) -> None:
        """Carry a request out, beside this loop."""
        writer, act = self._acts[ours]
        related = (found.inline.get(rtps.RELATED_OF_FAST_DDS) or found.inline.get(rtps.RELATED) or [b""])[0]
        guid = related[:16] if len(related) >= 16 and any(related[:16]) else prefix + found.writer
        identity = guid + rtps.number_bytes(found.number)
        if not self._waiting.acquire(blocking=False):
            self._answers.append((prefix, writer, identity, False, "busy: too many calls at once"))
            return

        def work() -> None:
            try:
                done, said = act()
            finally:
                self._waiting.release()
            self._answers.append((prefix, writer, identity, done, said))

        threading.Thread(target=work, name="tare", daemon=True).start()

    def _reply(self, prefix: bytes, name: bytes, identity: bytes, success: bool, said: str) -> None:
        payload = rtps.CDR + struct.pack("<?3x", success) + rtps.text(said[:500])
        inline = rtps.parameter_list([(rtps.RELATED_OF_FAST_DDS, identity), (rtps.RELATED, identity)])
        number = self._writers[name].add(payload.ljust((len(payload) + 3) & ~3, b"\0"), inline)
        if (peer := self._peers.get(prefix)) is not None:
            self._again(prefix, peer, name, {number})
            self._heartbeats(prefix)

    def close(self) -> None:
        """Answer no more."""
        self._stop = True
        self._thread.join(2.0)
        self._socket.close()


def _own_address() -> str:
    """The address of this host towards the others."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect((GROUP, 7400))
            return str(probe.getsockname()[0])
        except OSError:
            return "127.0.0.1"
