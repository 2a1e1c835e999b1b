"""Keys that are missing, wrong, half configured, readable by others or taken away, over TCP on this host's loopback.

The promise: nobody reads who is not listed, nobody is believed who is not the service, nobody changes anything who is
no operator; and who is listed gets every frame meanwhile. `frames` counts messages sent to somebody who must not get
them, `refused_%` the share that did not arrive.
"""

from __future__ import annotations

import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import zmq

from bench.stability.run import Row, Setting
from protocol import transport
from protocol.control import ControlClient, ControlError, ControlServer
from protocol.frames import ContactFrame, pack
from protocol.sockets import AllReader, Publisher
from protocol.transport import Transport, TransportError, write_keys

CONNECT_S = 5.0  # for who may read to get the first frame
SENT = 40  # frames after that, one every PERIOD_S
PERIOD_S = 0.01
ENDED_S = 2.0  # after it was taken away a key opens nothing any more

Context = zmq.Context[zmq.Socket[bytes]]


class Site:
    """The keys of a robot, of a client `arm` and an operator `chief`, which its folders list, and of a `stranger`."""

    def __init__(self, folder: Path, context: Context) -> None:
        self.folder, self.context = folder, context
        for name in ("robot", "arm", "chief", "stranger"):
            write_keys(folder / "keys", name)
        for listed, name in (("clients", "arm"), ("operators", "chief")):
            (folder / listed).mkdir()
            shutil.copy(folder / "keys" / f"{name}.key", folder / listed)
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.address = f"tcp://127.0.0.1:{free.getsockname()[1]}"

    def use(self, name: str) -> None:
        """Have this process open sockets as `robot` or as a client of it from now on; "" is a client without any
        key.
        """
        addresses = {"publisher": self.address, "publisher.ctl": self.address}
        secret = self.folder / "keys" / f"{name}.key_secret"
        if not name:
            transport.configure(Transport(addresses=addresses))
        elif name == "robot":
            clients, operators = self.folder / "clients", self.folder / "operators"
            transport.configure(Transport(secret_key=secret, clients=clients, operators=operators))
        else:
            keys = {"publisher": self.folder / "keys" / "robot.key"}
            transport.configure(Transport(addresses=addresses, secret_key=secret, server_keys=keys))

    def publisher(self) -> Publisher:
        self.use("robot")
        return Publisher("publisher", self.context, address=self.address)

    def reader(self, name: str) -> AllReader:
        self.use(name)
        return AllReader(["contact"], "palm", context=self.context)


def sends(
    publisher: Publisher, readers: list[AllReader], enough: Callable[[list[int]], bool], most_s: float
) -> list[int]:
    """Frames until `enough` were got, or for most_s; how many each reader got."""
    got, end = [0] * len(readers), time.monotonic() + most_s
    while time.monotonic() < end and not enough(got):
        publisher.mind()
        publisher.send(ContactFrame(skin="palm"))
        time.sleep(PERIOD_S)
        for n, reader in enumerate(readers):
            while reader.recv(0.0) is not None:
                got[n] += 1
    return got


def _row(sent: int, arrived: int, **broken: int) -> Row:
    found = {how.replace("_", " "): n for how, n in broken.items() if n}
    return {"frames": sent, "refused_%": 100 * (1 - arrived / sent), "broken": found}


def unlisted(name: str) -> Callable[[Site], Row]:
    """A reader whose key the robot does not list, beside one whose key it does."""

    def attack(site: Site) -> Row:
        publisher = site.publisher()
        (site.folder / "clients" / "torn.key").write_text("rubbish")
        good, bad = readers = [site.reader("arm"), site.reader(name)]
        got = sends(publisher, readers, lambda got: got[0] >= SENT, CONNECT_S)
        for socket_ in (publisher, good, bad):
            socket_.close()
        return _row(SENT, min(SENT, got[1]), read_by_a_stranger=got[1], a_listed_key_was_refused=int(got[0] < SENT))

    return attack


def taken_away(site: Site) -> Row:
    """The key of a live connection is removed from the folder."""
    publisher = site.publisher()
    good, gone = readers = [site.reader("chief"), site.reader("arm")]
    before = sends(publisher, readers, lambda got: min(got) > 0, CONNECT_S)
    (site.folder / "clients" / "arm.key").unlink()
    sends(publisher, readers, lambda _: False, ENDED_S)
    got = sends(publisher, readers, lambda got: got[0] >= SENT, CONNECT_S)
    for socket_ in (publisher, good, gone):
        socket_.close()
    refused = int(min(before) == 0 or got[0] < SENT)
    return _row(SENT, min(SENT, got[1]), read_with_a_key_that_was_taken_away=got[1], a_listed_key_was_refused=refused)


def impostor(keyed: bool) -> Callable[[Site], Row]:
    """Somebody else answers at the robot's address: in clear, or with a key pair of its own."""

    def attack(site: Site) -> Row:
        fake = site.context.socket(zmq.PUB)
        fake.linger = 0
        if keyed:
            fake.curve_publickey, fake.curve_secretkey = zmq.curve_keypair()
            fake.curve_server = True
        fake.bind(site.address)
        reader = site.reader("arm")
        arrived = 0
        for _ in range(SENT):
            fake.send(pack(ContactFrame(skin="palm", valid=True)))
            arrived += reader.recv(PERIOD_S) is not None
        fake.close()
        reader.close()
        return _row(SENT, arrived, an_impostor_was_believed=arrived)

    return attack


def half_configured(site: Site) -> Row:
    """Configurations that would leave something open: none of them may be used."""
    keys = site.folder / "keys"
    own, robot, clients = keys / "arm.key_secret", {"publisher": keys / "robot.key"}, site.folder / "clients"
    readable = keys / "stranger.key_secret"
    readable.chmod(0o644)
    configurations = [
        Transport(secret_key=own),
        Transport(server_keys=robot),
        Transport(clients=clients),
        Transport(secret_key=own, server_keys=robot, operators=site.folder / "operators"),
        Transport(secret_key=keys / "arm.key", server_keys=robot),
        Transport(secret_key=readable, server_keys=robot),
        Transport(secret_key=own, server_keys={"publisher": keys / "nobody.key"}),
        Transport(secret_key=own, clients=site.folder / "nobody"),
    ]
    used = 0
    for configuration in configurations:
        try:
            transport.configure(configuration)
        except TransportError:
            continue
        used += 1
    return _row(len(configurations), used, half_a_configuration_was_used=used)


def commands(site: Site) -> Row:
    """`tare` from a client, which may only look; the operator's is carried out."""
    carried_out: list[str] = []
    site.use("robot")

    def tare(args: dict[str, Any]) -> dict[str, Any]:
        carried_out.append(args["skin"])
        return {}

    handlers = {"tare": tare, "status": lambda args: {}}
    server = ControlServer("publisher", handlers, address=site.address, context=site.context)
    answers: dict[str, str] = {}

    def ask() -> None:
        for name in ("arm", "chief"):
            site.use(name)
            try:
                ControlClient("publisher", CONNECT_S / 2, context=site.context).call("tare", skin=name)
                answers[name] = "carried out"
            except ControlError as refused:
                answers[name] = refused.kind

    asking = threading.Thread(target=ask)
    asking.start()
    while asking.is_alive():
        server.serve_once(0.02)
    asking.join()
    server.close()
    return _row(
        1,
        carried_out.count("arm"),
        a_client_changed_something=carried_out.count("arm"),
        a_client_was_not_told_why=int(answers["arm"] != "forbidden"),
        an_operator_was_refused=int(answers["chief"] != "carried out"),
    )


ATTACKS: dict[str, Callable[[Site], Row]] = {
    "a reader without a key": unlisted(""),
    "a reader with a key that is not listed": unlisted("stranger"),
    "a key taken away while it reads": taken_away,
    "an impostor in clear": impostor(keyed=False),
    "an impostor with keys of its own": impostor(keyed=True),
    "keys configured by half, or readable by others": half_configured,
    "a client that gives commands": commands,
}


def attacked(setting: Setting) -> Iterator[Row]:
    for name, attack in ATTACKS.items():
        before = transport.current()
        with tempfile.TemporaryDirectory(prefix="eit", dir="/tmp") as folder, zmq.Context() as context:
            try:
                yield {"case": name, **attack(Site(Path(folder), context))}
            finally:
                transport.configure(before)
                transport.stop_gate(context)
                context.destroy(linger=0)


PARTS: dict[str, Callable[[Setting], Iterator[Row]]] = {"keys": attacked}
