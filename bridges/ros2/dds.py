"""Our side of the DDS wire: one participant, writers that take finished bytes and say who listens.

ROS 2's side of it asks for: topics named `rt/...`, types named `..::dds_::.._`, plain CDR, types compared by name alone
(no two implementations describe a type alike), and the type's hash in the user data.
"""

from __future__ import annotations

import os
from functools import cache
from typing import Any, Literal

from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.idl.annotations import final
from cyclonedds.internal import InvalidSample
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from . import cdr
from .definitions import TABLE, dds_name, members, type_hash

Kind = Literal["state", "sensor", "latched"]
_IDL: dict[str, Any] = {
    "bool": bool,
    "byte": types.byte,
    "uint8": types.uint8,
    "int32": types.int32,
    "uint32": types.uint32,
    "float32": types.float32,
    "float64": types.float64,
    "string": str,
}
_QOS = {
    # wrench, contacts: every one arrives. A reliable writer serves readers of either kind.
    "state": (Policy.Reliability.Reliable(100_000_000), Policy.History.KeepLast(10), Policy.Durability.Volatile),
    # cloud, image: the newest, or none
    "sensor": (Policy.Reliability.BestEffort, Policy.History.KeepLast(1), Policy.Durability.Volatile),
    # tf_static: whoever comes late is given the last one
    "latched": (Policy.Reliability.Reliable(100_000_000), Policy.History.KeepLast(1), Policy.Durability.TransientLocal),
}

DATAGRAM, FRAGMENT = 65500, 65000
"""Bytes of the largest UDP datagram, as with Fast DDS, and of a message's part in one. With Cyclone's own (14720, 1344)
a cloud of 184 kB is 14 datagrams, which overflow the receive buffer of a ROS node that does not read at once (208 kB
with what the kernel adds to each): half of the clouds were lost. Of these 3 none is.
"""


READ_AT_ONCE = 1000
"""Messages of another node that are held for us: a second of a fast force-torque sensor."""


def domain_id(given: int | None) -> int:
    """The ROS domain: as configured, else as $ROS_DOMAIN_ID says, as for every ROS 2 node."""
    if given is not None:
        return given
    said = os.environ.get("ROS_DOMAIN_ID", "").strip() or "0"
    if not said.isdigit() or int(said) > 232:
        raise ValueError(f"ROS_DOMAIN_ID is {said!r}, expected a number from 0 to 232")
    return int(said)


def interface(given: str) -> str:
    """The only network interface to use, "" for those that Cyclone chooses: "lo" too where ROS's own variables ask for
    this host alone.
    """
    here = os.environ.get("ROS_AUTOMATIC_DISCOVERY_RANGE", "").upper() == "LOCALHOST"
    if here or os.environ.get("ROS_LOCALHOST_ONLY", "0") not in ("", "0"):
        return given or "lo"
    return given


def configure(given: str) -> None:
    """Tell Cyclone DDS what ROS 2 needs, `given` being the interface of skin.toml. With $CYCLONEDDS_URI the interfaces
    are its own business.
    """
    theirs = os.environ.get("CYCLONEDDS_URI", "")
    name = "" if theirs else interface(given)
    text = "<Compatibility><IgnoreTypeInformation>1.15</IgnoreTypeInformation></Compatibility>"
    text += f"<General><MaxMessageSize>{DATAGRAM}B</MaxMessageSize><FragmentSize>{FRAGMENT}B</FragmentSize></General>"
    if name:
        alone = ' multicast="false"' if name == "lo" else ""  # the loopback has none
        text += f'<General><Interfaces><NetworkInterface name="{name}"{alone}/></Interfaces></General>'
    if name == "lo":
        text += '<Discovery><Peers><Peer Address="localhost"/></Peers>'
        text += "<ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex>"
        text += "</Discovery>"
    ours = f"<CycloneDDS><Domain>{text}</Domain></CycloneDDS>"
    os.environ["CYCLONEDDS_URI"] = f"{ours},{theirs}" if theirs else ours


@cache
def idl_type(message: str) -> type[IdlStruct]:
    """The type as DDS announces it."""
    fields: dict[str, Any] = {}
    for member in members(message):
        kind = idl_type(member.type) if member.type in TABLE else _IDL[member.type]
        fields[member.name] = types.sequence[kind] if member.sequence else kind  # type: ignore[misc]
    made: type[IdlStruct] = final(
        make_idl_struct(message.replace("/", "_"), dds_name(message).replace("::", "."), fields)
    )
    # Cyclone asks a sample for its bytes; ours are made already (an IDL sequence is packed byte by byte: 37 kB, 20 ms).
    made.serialize = _finished  # type: ignore[method-assign, assignment]
    return made


def _finished(sample: Any, **_: object) -> bytes:
    data: bytes = sample.finished
    return data


class RosReader:
    """Reads one ROS topic of another node, whether that sends reliably or not."""

    def __init__(self, participant: DomainParticipant, name: str, message: str) -> None:
        qos = Qos(
            Policy.Reliability.BestEffort,
            Policy.History.KeepLast(READ_AT_ONCE),
            Policy.Durability.Volatile,
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        topic: Topic[Any] = Topic(participant, f"rt{name}", idl_type(message))
        self._reader: DataReader[Any] = DataReader(participant, topic, qos)

    def take(self) -> list[Any]:
        """The messages since the last call, oldest first, the newest READ_AT_ONCE of them."""
        return [found for found in self._reader.take(READ_AT_ONCE) if not isinstance(found, InvalidSample)]


class RosWriter:
    """Publishes one ROS topic."""

    def __init__(self, participant: DomainParticipant, name: str, message: str, kind: Kind) -> None:
        self.name, self.message = name, message
        self.sent = 0
        qos = Qos(
            *_QOS[kind],
            Policy.DataRepresentation(use_cdrv0_representation=True),
            Policy.Userdata(f"typehash={type_hash(message)};".encode()),
        )
        self._type = idl_type(message)
        topic: Topic[Any] = Topic(participant, f"rt{name}", self._type)
        self._writer: DataWriter[Any] = DataWriter(participant, topic, qos)

    @property
    def wanted(self) -> bool:
        """Whether anybody subscribes."""
        return bool(self._writer.get_matched_subscriptions())

    def write(self, value: cdr.Value) -> None:
        """Send a message, given as a map from field to value."""
        sample = self._type.__new__(self._type)
        sample.finished = cdr.encode(self.message, value)  # type: ignore[attr-defined]
        self._writer.write(sample)
        self.sent += 1
