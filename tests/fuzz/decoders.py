"""What reads bytes of others, as functions of bytes: an error of its own is swallowed, anything else is a fault."""

import atexit
import contextlib
import functools
import hashlib
import io
import json
import logging
import os
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import Mock, patch

import msgpack
import numpy as np

from models import bundle as bundles
from models.files import FileError
from models.npz import npz
from protocol import transport
from protocol.cobs import cobs_decode, cobs_encode
from protocol.control import ControlClient, ControlError, ControlServer
from protocol.frames import FrameError, RawFrame, pack, read_map, unpack
from protocol.link import SCHEMA_HASH, Decoder
from protocol.link_messages import BY_NUMBER
from protocol.topics import TOPICS
from services.calibration import presses_csv as calibration_csv
from services.calibration.force_fit import CalibrationError
from services.contacts.force import calibration_file as calibration
from services.estimation.initialisation.baseline import Baseline
from services.preprocessing import Preprocessing
from services.recordings import settings
from services.recordings.recording import RecordingError, RecordingReader, RecordingWriter
from services.recordings.replay import skins_in, steps
from services.runtime import persistence
from services.runtime.config import ConfigError, Skin, load
from services.runtime.stage import Refused

CORPUS = Path(__file__).parent / "corpus"
ROOT = Path(__file__).resolve().parents[2]
PALM = Skin(port="stub", bundle="square16", frame_id="palm")


@cache
def folder() -> Path:
    logging.disable(logging.CRITICAL)
    made = Path(tempfile.mkdtemp(prefix="eitfuzz", dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


@contextlib.contextmanager
def said(error: type[Exception], text: str | Path = "") -> Iterator[None]:
    """What may be raised, and says something."""
    try:
        yield
    except error as why:
        assert str(why) and str(text) in str(why)


@contextlib.contextmanager
def written(name: str, data: bytes) -> Iterator[Path]:
    (folder() / name).write_bytes(data)
    yield folder() / name


def frame(data: bytes) -> None:
    """A message as a subscriber gets it. What is taken for a frame can be sent on."""
    with said(FrameError):
        pack(unpack(data))


def fields(data: bytes) -> None:
    """The same behind a topic that there is: the first byte says which."""
    names = list(TOPICS)
    if data:
        frame(names[data[0] % len(names)].encode() + b"/palm\0" + data[1:])


_bundle = cache(lambda: bundles.Bundle.load("square16"))
_stage = cache(lambda: Preprocessing("palm", PALM, _bundle()))


@cache
def _server() -> tuple[ControlServer, list[dict[str, Any]]]:
    """`load` as the runner's, which takes over what a recording holds; and what was taken over."""
    taken: list[dict[str, Any]] = []

    def load(args: dict[str, Any]) -> dict[str, Any]:
        _stage().reset()
        _stage().load(persistence.arrays(args["state"]))
        taken.append(args)
        return {}

    handlers = {"load": load, "tare": lambda args: _stage().command("tare", args)}
    return ControlServer("preprocessing", handlers, address="inproc://fuzz"), taken


def request(data: bytes) -> None:
    """A command. There is an answer to everything, and the answer can be read."""
    server, taken = _server()
    taken.clear()
    assert read_map(server._answer(data, ""), "reply")["ok"] in (True, False)
    if taken:  # what was taken over can be worked with
        _stage().process(_scan(), frozenset(("delta",)))
        persistence.plain(_stage().state())


def reply(data: bytes) -> None:
    """What a process answers to a command of ours."""
    answering = Mock(**{"poll.return_value": 1, "recv.return_value": data})
    with said(ControlError), patch.object(transport, "connect", lambda *_: answering):
        ControlClient("publisher", address="ipc://nowhere").call("clock")


def line(data: bytes) -> None:
    """The serial line: pieces of any size, and never a piece kept for ever."""
    decoder = Decoder()
    decoder.feed(data)
    for at in range(0, len(data), 7):
        decoder.feed(data[at : at + 7])
    assert len(decoder._rest) <= 2 * 8192


def body(data: bytes) -> None:
    """A message of the link whose checksum is right: each number's fields are read."""
    if not data:
        return
    kind = BY_NUMBER.get(data[0])
    crc = zlib.crc32(data, 0 if kind and kind.plain_crc else SCHEMA_HASH)
    decoder = Decoder()
    messages = decoder.feed(b"\0" + cobs_encode(data + struct.pack("<I", crc)) + b"\0")
    assert len(messages) + decoder.bad <= 1
    for message in messages:
        assert message.body() is not None


def recording(data: bytes) -> None:
    with said(RecordingError), written("a.mcap", data) as path:
        list(steps(reader := RecordingReader(path)))
        assert len(skins_in(reader)) <= 64 and str(reader.damage)
        settings.read(reader.metadata.get(settings.KEY, ""), path)


def carried(data: bytes) -> None:
    """The settings of a recording, to the file that the stages read."""
    with said(RecordingError):
        found = settings.read(data.decode("utf-8", "replace"), Path("a.mcap"))
        content = settings.configuration(found, settings.Known.here(None), folder())
        (folder() / "carried.toml").write_text(settings.toml(content), encoding="utf-8")
        if found.skins:
            config = load(folder() / "carried.toml")
            assert config.sockets.addresses == {} and not config.security.insecure


def state(data: bytes) -> None:
    """A kept state whose checksum is right, to the stage that takes it over."""
    os.environ["EITSKIN_RUNTIME"] = str(folder() / "rt")
    for kept in (folder() / "rt", folder() / "rt" / "state"):
        kept.mkdir(mode=0o700, exist_ok=True)
    file = kept / "preprocessing-palm.msgpack"
    file.write_bytes(hashlib.sha256(data).digest() + data)
    file.chmod(0o600)
    found, stage = persistence.restore("preprocessing", "palm"), _stage()
    if found is None:
        return
    stage.reset()
    with contextlib.suppress(Refused):
        stage.restore(*found)
        stage.process(_scan(), frozenset(("delta",)))  # what was taken over can be worked with


@cache
def _scan() -> RawFrame:
    z0 = _bundle().z0
    return RawFrame(skin="palm", scan=1, z=z0.astype("c8"), status=np.zeros(len(z0), "u1"), stamps={"sample": 10**9})


def arrays(data: bytes) -> None:
    with said(FileError):
        npz(io.BytesIO(data), "a.npz")


def configuration(data: bytes) -> None:
    with said(ConfigError, "skin.toml"), written("skin.toml", data) as path:
        load(path).transport()


def manifest(data: bytes) -> None:
    """A manifest whose hash is right, beside matrices that are."""
    path = folder() / "bundle"
    if not path.exists():
        shutil.copytree(_bundle().path, path, ignore=shutil.ignore_patterns("*.png", "network*"))
    (path / "manifest.json").write_bytes(data)
    bundles.seal(path)
    with said(bundles.BundleError, path):
        found = bundles.Bundle.load(path)
        assert 0 < found.metres_per_pixel < 1e6 and found.image_size > 0


def law(data: bytes) -> None:
    with said(ConfigError, "law.json"), written("law.json", data) as path:
        found = calibration.load(path, Skin(port="stub", bundle="square16"), _bundle())
        assert found.curve(0.1) >= 0 and found.most_n > 0


def presses(data: bytes) -> None:
    with said(CalibrationError, "presses.csv"), written("presses.csv", data) as path:
        calibration_csv.read(path)


def seeds(name: str) -> list[bytes]:
    """Where mutation begins: small inputs that are right, and some that once were too much: the corpus too."""
    return [*SEEDS[name](), *(path.read_bytes() for path in sorted((CORPUS / name).glob("*")))]


def _vectors(kind: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((ROOT / "protocol" / "vectors" / kind).glob("*.bin"))]


def _fields() -> list[bytes]:
    split = [message.partition(b"\0") for message in _vectors("frames")]
    return [bytes([list(TOPICS).index(head.partition(b"/")[0].decode())]) + rest for head, _, rest in split]


def _packed(*values: Any) -> list[bytes]:
    return [msgpack.packb(value) for value in values]


HUGE = {"dtype": "<f8", "shape": [2**40, 2**40, 0], "data": b""}
NESTED: list[Any] = functools.reduce(lambda value, _: [value], range(1000), [])


def _kept(taken_s: float = 1.0) -> dict[str, Any]:
    stage, z0 = _stage(), _bundle().z0
    stage.reset()
    stage.set_baseline(Baseline(z0.copy(), 1e-3 * z0, 64, "board", 10**9))
    assert stage.baseline is not None
    return persistence.plain({"bundle": _bundle().hash, "baseline": stage.baseline.to_dict(), "taken_s": taken_s})


def _requests() -> list[bytes]:
    _kept()
    states = persistence.plain(_stage().state()), {"baseline": None, "z": HUGE}, NESTED[0][0]
    loads = ({"command": "load", "args": {"skin": "palm", "state": state}} for state in states)
    return _packed(*loads, {"command": "tare", "args": {"force": True}}, {"command": NESTED, "args": {}})


def _recordings() -> list[bytes]:
    path = folder() / "seed.mcap"
    with RecordingWriter(path, {settings.KEY: settings.text_of({"palm": PALM})}, overwrite=True) as writer:
        writer.write("raw/palm", pack(_scan()).partition(b"\0")[2], 10**18)
        writer.write("state/palm", msgpack.packb({"preprocessing": {"z": HUGE}}), 10**18)
    return [path.read_bytes()]


def _archives() -> list[bytes]:
    for save in (np.savez, np.savez_compressed):
        save(folder() / f"{save.__name__}.npz", measurements=np.ones((2, 3)), text=np.array("a"), none=np.zeros((0, 3)))
    return [path.read_bytes() for path in folder().glob("savez*.npz")]


def _manifests() -> list[bytes]:
    said = {k: v for k, v in _bundle().manifest.items() if k != "network"}
    said["files"] = {"matrices.npz": said["files"]["matrices.npz"]}
    text = json.dumps(said)
    return [text.encode(), text.replace("0.05", "NaN").encode(), text.replace("96", "1e999").encode()]


SEEDS: dict[str, Callable[[], list[bytes]]] = {
    "frame": lambda: [*_vectors("frames"), b"raw/palm\0" + msgpack.packb({"z": HUGE})],
    "fields": _fields,
    "request": _requests,
    "reply": lambda: _packed(
        {"ok": True, "result": {"monotonic_ns": 1}}, {"ok": False, "error": {"type": "refused", "message": "no"}},
        {"ok": False, "error": {"type": NESTED, "message": 3}}, [1],
    ),
    "line": lambda: [*_vectors("link"), b"\0" + bytes(range(1, 256)) + b"\0", b"\x01" * 300],
    "body": lambda: [cobs_decode(piece.strip(b"\0"))[:-4] for piece in _vectors("link")],
    "recording": _recordings,
    "carried": lambda: [settings.text_of({"palm": PALM}).encode(), b'{"skins": {}}'],
    "state": lambda: _packed(*({"saved_unix_s": 1e9, "state": k} for k in (_kept(), {"z": HUGE}, _kept(1e308)))),
    "arrays": _archives,
    "configuration": lambda: [(ROOT / "skin.toml").read_bytes(), b'[skins.a]\nport = "stub"\nrtia_ohm = nan'],
    "manifest": _manifests,
    "law": lambda: [b'{"newtons_per_siemens": 10.0, "most_n": 5.0}', b'{"newtons_per_siemens": NaN}', b"[" * 3000],
    "presses": lambda: [
        b"force_n,x_m,y_m,pressure_n,peak_s_per_m,integral_s_m\n1,0,0,1,0.1,1e-6\n", b"force_n,row\n1,1e400\n",
    ],
}  # fmt: skip
TARGETS: dict[str, Callable[[bytes], None]] = {name: globals()[name] for name in SEEDS}
