"""The sections of skin.toml that are not one skin's: sockets, keys, the kernel, skip rules, bridges, logging."""

from __future__ import annotations

import itertools
import re
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from protocol.topics import PRODUCERS
from protocol.transport import Transport, half
from services.runtime.stage import PROCESSES

Switch = Annotated[bool, Field(strict=True)]  # true or false; no word, which would be taken for true
Number = Annotated[float, Field(strict=True)]  # no true, which would be taken for 1.0, and no word
Count = Annotated[int, Field(strict=True)]


class Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class Sockets(Section):
    """Where processes publish and take commands: ipc sockets in the runtime folder, or the addresses given here."""

    addresses: dict[str, str] = {}  # producer, or "<process>.ctl" for its control socket -> tcp://host:port

    @field_validator("addresses")
    @classmethod
    def known(cls, addresses: dict[str, str]) -> dict[str, str]:
        for name, address in addresses.items():
            if name.removesuffix(".ctl") not in PRODUCERS:
                raise ValueError(f"producers {', '.join(PRODUCERS)}, or one of these with .ctl (found {name!r})")
            port = address.rpartition(":")[2] if address.startswith("tcp://") else "1"
            if not re.fullmatch(r"(tcp://\S+:\d{1,5}|ipc://\S+)", address) or not 1 <= int(port) <= 65535:
                raise ValueError(f"tcp://HOST:PORT or ipc://PATH (found {address!r} for {name})")
        for (name, address), (other, same) in itertools.combinations(addresses.items(), 2):
            if _overlap(address, same):
                raise ValueError(
                    f"an address of its own for each socket ({name} has {address!r}, {other} has {same!r}: "
                    "only one of them could listen there)"
                )
        return addresses


def _overlap(one: str, other: str) -> bool:
    """Whether two addresses cannot both be listened at."""
    if not (one.startswith("tcp://") and other.startswith("tcp://")):
        return one == other
    (host, _, port), (other_host, _, other_port) = (a.removeprefix("tcp://").rpartition(":") for a in (one, other))
    host, other_host = (name.replace("localhost", "127.0.0.1") for name in (host, other_host))
    every = {"*", "0.0.0.0", "[::]"}
    return int(port) == int(other_port) and (host == other_host or bool(every & {host, other_host}))


class Security(Section):
    """CURVE keys for tcp addresses (`skin keys new`). Unencrypted connections beyond this host are refused unless
    `insecure` says so.
    """

    secret_key: Path | None = None  # our own key pair
    server_keys: dict[str, Path] = {}  # producer -> its public key
    clients: Path | None = None  # folder with the public keys that may connect
    operators: Path | None = None  # folder with those that may also give commands that change something
    insecure: Switch = False

    @field_validator("server_keys")
    @classmethod
    def known(cls, keys: dict[str, Path]) -> dict[str, Path]:
        for name in keys:
            if name not in PRODUCERS:
                raise ValueError(f"producers {', '.join(PRODUCERS)} (found {name!r})")
        return keys

    @model_validator(mode="after")
    def whole(self) -> Security:
        if missing := half(self.transport({}, Path())):
            raise ValueError(missing)
        return self

    def transport(self, addresses: dict[str, str], folder: Path) -> Transport:
        """For `protocol.transport.configure`; relative paths are relative to `folder`."""
        return Transport(
            addresses=addresses,
            secret_key=folder / self.secret_key if self.secret_key else None,
            server_keys={name: folder / key for name, key in self.server_keys.items()},
            clients=folder / self.clients if self.clients else None,
            operators=folder / self.operators if self.operators else None,
            insecure=self.insecure,
        )


class Logging(Section):
    level: Literal["debug", "info", "warning", "error"] = "info"


class RealTime(Section):
    """What each process asks of the kernel: services/runtime/realtime.py. What is refused is said in `status`."""

    priority: Annotated[Count, Field(ge=0, le=99)] = 0  # of SCHED_FIFO; 0: the ordinary scheduler
    lock_memory: Switch = False  # mlockall: no page of it is ever swapped out
    cpus: dict[str, list[Annotated[Count, Field(ge=0)]]] = {}  # process -> processors it may run on

    @field_validator("cpus")
    @classmethod
    def known(cls, cpus: dict[str, list[int]]) -> dict[str, list[int]]:
        for name, numbers in cpus.items():
            if name not in PROCESSES:
                raise ValueError(f"processes {', '.join(PROCESSES)} (found {name!r})")
            if not numbers:
                raise ValueError(f"at least one processor, counted from 0 (found none for {name})")
        return cpus


class Skip(Section):
    """Switches of the skip rules that are not one skin's own (those are `touch` and `scan`). All on, but to measure."""

    batch: Switch = True  # skins whose frames wait at once share a run of the network
    unwanted: Switch = True  # what nobody subscribes to (force, shape, judgements) is not made


class RecorderSection(Section):
    """The recorder that `skin up` starts where there is this section: services/recorder.py, docs/recording.md."""

    folder: str = "recordings"  # relative to the folder of this file
    before_s: Annotated[Number, Field(gt=0, le=600)] = 10.0  # what a snapshot has of the time before its event
    after_s: Annotated[Number, Field(ge=0, le=300)] = 5.0
    triggers: tuple[Literal["contact", "fault"], ...] = ()  # events that a snapshot is taken of by itself
    keep_snapshots: Annotated[Count, Field(ge=0)] = 100  # of those taken by themselves; 0: all
    memory_mb: Annotated[Number, Field(gt=0, le=4096)] = 64.0  # for the time before
    file_mb: Annotated[Number, Field(ge=0)] = 0.0  # a recording goes on in another file then; 0: whatever its size
    file_minutes: Annotated[Number, Field(ge=0)] = 0.0  # likewise; 0: however long
    keep_files: Annotated[Count, Field(ge=0)] = 0  # of one recording, the oldest are deleted; 0: all


HostName = Annotated[str, Field(pattern=r"^[A-Za-z0-9.-]{1,253}$")]


class PageSection(Section):
    """The live page: bridges/page, docs/page.md."""

    host: Annotated[str, Field(min_length=1, max_length=253)] = "127.0.0.1"
    port: Annotated[Count, Field(ge=1, le=65515)] = 8080  # or the first free one of the twenty from there
    names: tuple[HostName, ...] = ()  # further names it is asked for by
    recordings: str = "recordings"  # folder of the button Record where there is no [recorder]; "": no button
    metrics: Switch = False  # /metrics, for Prometheus


class FoxgloveSection(Section):
    """The live server for Foxglove: bridges/foxglove."""

    host: Annotated[str, Field(min_length=1, max_length=253)] = "127.0.0.1"
    port: Annotated[Count, Field(ge=0, le=65535)] = 8765
    names: tuple[HostName, ...] = ()  # further names it is asked for by
    # Of contacts, at most; one that begins, ends or comes to be known otherwise is told at once
    rate_hz: Annotated[Number, Field(gt=0, le=1000)] = 60.0
    replay: Switch = False  # replayed frames are shown too
