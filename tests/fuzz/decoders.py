"""Everything that reads bytes of others, each as a function of bytes that must not raise: tests feed it what hypothesis
makes and the kept corpus, run.py what atheris finds.

A decoder's own error is the right answer to rubbish, and is swallowed here; anything else is a fault.
"""

from __future__ import annotations

import atexit
import hashlib
import io
import json
import logging
import os
import shutil
import struct
import tempfile
import zlib
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

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
from services.preprocessing import Preprocessing
from services.recordings import settings
from services.recordings.recording import RecordingError, RecordingReader
from services.recordings.replay import skins_in, steps
from services.runtime import persistence
from services.runtime.config import ConfigError, Skin, load

CORPUS = Path(__file__).parent / "corpus"
ROOT = Path(__file__).resolve().parents[2]
PALM = Skin(port="stub", bundle="square16", frame_id="palm")


@cache
def folder() -> Path:
    """Where files are put for those decoders that read files."""
    logging.disable(logging.CRITICAL)
    memory = Path("/dev/shm")
    made = Path(tempfile.mkdtemp(prefix="eitfuzz", dir=memory if os.access(memory, os.W_OK) else None))
    atexit.register(shutil.rmtree, made, ignore_errors=True)
    return made


def frame(data: bytes) -> None:
    """A message as a subscriber gets it. What is taken for a frame can be sent on."""
    try:
        found = unpack(data)
    except FrameError as why:
        str(why)
        return
    pack(found)


def fields(data: bytes) -> None:
    """The same behind a topic that there is: the first byte says which."""
    names = list(TOPICS)
    if data:
        frame(names[data[0] % len(names)].encode() + b"/palm\0" + data[1:])


@cache
def _stage() -> Preprocessing:
    return Preprocessing("palm", PALM, _bundle())


@cache
def _bundle() -> bundles.Bundle:
    return bundles.Bundle.load("square16")


@cache
def _server() -> ControlServer:
    """`load` as the runner's, which takes over what a recording holds. Its socket is of this process alone."""
    handlers = {"load": _load, "tare": lambda args: _stage().command("tare", args)}
    return ControlServer("preprocessing", handlers, address="inproc://fuzz")


_broken: list[Exception] = []


def _load(args: dict[str, Any]) -> dict[str, Any]:
    """As the runner's: what is taken over can be worked with, or the stage refuses it."""
    _stage().reset()
    _stage().load(persistence.arrays(args["state"]))
    try:
        _stage().process(_scan(), frozenset(("delta",)))
        return persistence.plain(_stage().state())
    except Exception as why:
        _broken.append(why)
        raise


def request(data: bytes) -> None:
    """A command. There is an answer to everything, and the answer can be read."""
    _broken.clear()
    reply = read_map(_server()._answer(data, ""), "reply")
    assert reply["ok"] in (True, False)
    if _broken:
        raise _broken[0]


def reply(data: bytes) -> None:
    """What a process answers to a command of ours."""

    class Answering:
        def poll(self, *_: Any) -> int:
            return 1

        def send(self, *_: Any) -> None: ...

        def recv(self, *_: Any) -> bytes:
            return data

        def close(self, *_: Any) -> None: ...

    connect, transport.connect = transport.connect, lambda *_: Answering()  # type: ignore[assignment,return-value]
    try:
        ControlClient("publisher", address="ipc://nowhere").call("clock")
    except ControlError as why:
        assert str(why)
    finally:
        transport.connect = connect


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
    path = folder() / "a.mcap"
    path.write_bytes(data)
    try:
        reader = RecordingReader(path)
        for _ in steps(reader):
            pass
        assert len(skins_in(reader)) <= 64 and str(reader.damage)
        settings.read(reader.metadata.get(settings.KEY, ""), path)
    except RecordingError as why:
        assert str(why)


@cache
def _known() -> settings.Known:
    return settings.Known.here(None)


def carried(data: bytes) -> None:
    """The settings of a recording, to the file that the stages read."""
    try:
        found = settings.read(data.decode("utf-8", "replace"), Path("a.mcap"))
        content = settings.configuration(found, _known(), folder())
        (folder() / "carried.toml").write_text(settings.toml(content), encoding="utf-8")
        if found.skins:
            config = load(folder() / "carried.toml")
            assert config.sockets.addresses == {} and not config.security.insecure
    except RecordingError as why:
        assert str(why)


def state(data: bytes) -> None:
    """A kept state whose checksum is right, to the stage that takes it over."""
    os.environ["EITSKIN_RUNTIME"] = str(folder() / "rt")
    kept = folder() / "rt" / "state"
    if not kept.exists():
        kept.parent.mkdir(mode=0o700, exist_ok=True)
        kept.mkdir(mode=0o700)
    file = kept / "preprocessing-palm.msgpack"
    file.write_bytes(hashlib.sha256(data).digest() + data)
    file.chmod(0o600)
    found = persistence.restore("preprocessing", "palm")
    if found is not None:
        from services.runtime.stage import Refused

        stage = _stage()
        stage.reset()
        try:
            stage.restore(*found)
        except Refused:
            return
        stage.process(_scan(), frozenset(("delta",)))  # what was taken over can be worked with


@cache
def _scan() -> RawFrame:
    z0 = _bundle().z0
    return RawFrame(skin="palm", scan=1, z=z0.astype("c8"), status=np.zeros(len(z0), "u1"), stamps={"sample": 10**9})


def arrays(data: bytes) -> None:
    try:
        npz(io.BytesIO(data), "a.npz")
    except FileError as why:
        assert str(why)


def configuration(data: bytes) -> None:
    path = folder() / "skin.toml"
    path.write_bytes(data)
    try:
        load(path).transport()
    except ConfigError as why:
        assert str(path) in str(why)


@cache
def _bundle_folder() -> Path:
    made = folder() / "bundle"
    shutil.copytree(_bundle().path, made, ignore=shutil.ignore_patterns("*.png", "network*"))
    return made


def manifest(data: bytes) -> None:
    """A manifest whose hash is right, beside matrices that are."""
    path = _bundle_folder()
    (path / "manifest.json").write_bytes(data)
    bundles.seal(path)
    try:
        found = bundles.Bundle.load(path)
        assert 0 < found.metres_per_pixel < 1e6 and found.image_size > 0
    except bundles.BundleError as why:
        assert str(path) in str(why)


def law(data: bytes) -> None:
    path = folder() / "law.json"
    path.write_bytes(data)
    try:
        found = calibration.load(path, Skin(port="stub", bundle="square16"), _bundle())
        assert found.curve(0.1) >= 0 and found.most_n > 0
    except ConfigError as why:
        assert str(path) in str(why)


def presses(data: bytes) -> None:
    path = folder() / "presses.csv"
    path.write_bytes(data)
    try:
        calibration_csv.read(path)
    except CalibrationError as why:
        assert str(path) in str(why)


TARGETS: dict[str, Callable[[bytes], None]] = {
    target.__name__: target
    for target in (
        frame, fields, request, reply, line, body, recording, carried, state, arrays, configuration, manifest, law,
        presses,
    )
}  # fmt: skip


# Where mutation begins: small inputs that are right, and some that once were too much.


def seeds(name: str) -> list[bytes]:
    return SEEDS[name]()


def _vectors(kind: str) -> list[bytes]:
    return [path.read_bytes() for path in sorted((ROOT / "protocol" / "vectors" / kind).glob("*.bin"))]


def _fields() -> list[bytes]:
    split = [message.partition(b"\0") for message in _vectors("frames")]
    return [bytes([list(TOPICS).index(head.partition(b"/")[0].decode())]) + rest for head, _, rest in split]


def _bodies() -> list[bytes]:
    return [cobs_decode(piece.strip(b"\0"))[:-4] for piece in _vectors("link")]


def _packed(*values: Any) -> list[bytes]:
    return [msgpack.packb(value) for value in values]


HUGE = {"dtype": "<f8", "shape": [2**40, 2**40, 0], "data": b""}


def nested(depth: int) -> list[Any]:
    value: list[Any] = []
    for _ in range(depth):
        value = [value]
    return value


def _kept() -> dict[str, Any]:
    stage = _stage()
    stage.reset()
    from services.estimation.first.baseline import Baseline

    z0 = _bundle().z0
    stage.set_baseline(Baseline(z0.copy(), 1e-3 * z0, 64, "board", 10**9))
    baseline = stage.baseline
    assert baseline is not None
    return persistence.plain({"bundle": _bundle().hash, "baseline": baseline.to_dict(), "taken_s": 1.0})  # type: ignore[no-any-return]


def _requests() -> list[bytes]:
    stage = _stage()
    _kept()
    full = persistence.plain(stage.state())
    return _packed(
        {"command": "load", "args": {"skin": "palm", "state": full}},
        {"command": "load", "args": {"state": {"baseline": None, "z": HUGE}}},
        {"command": "tare", "args": {"force": True}},
        {"command": nested(1000), "args": {}},
        {"command": "load", "args": {"state": nested(900)}},
    )


def _recordings() -> list[bytes]:
    from services.recordings.recording import RecordingWriter

    path = folder() / "seed.mcap"
    text = settings.text_of({"palm": PALM})
    with RecordingWriter(path, {settings.KEY: text}, overwrite=True) as writer:
        writer.write("raw/palm", pack(_scan()).partition(b"\0")[2], 10**18)
        writer.write("state/palm", msgpack.packb({"preprocessing": {"z": HUGE}}), 10**18)
    return [path.read_bytes()]


def _archives() -> list[bytes]:
    made = []
    for save in (np.savez, np.savez_compressed):
        out = io.BytesIO()
        save(out, measurements=np.ones((2, 3)), text=np.array("model"), none=np.zeros((0, 3)))
        made.append(out.getvalue())
    return made


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
        {"ok": True, "result": {"monotonic_ns": 1}},
        {"ok": False, "error": {"type": "refused", "message": "no"}},
        {"ok": False, "error": {"type": nested(1000), "message": 3}},
        [1],
    ),
    "line": lambda: [*_vectors("link"), b"\0" + bytes(range(1, 256)) + b"\0", b"\x01" * 300],
    "body": _bodies,
    "recording": _recordings,
    "carried": lambda: [settings.text_of({"palm": PALM}).encode(), b'{"skins": {}}'],
    "state": lambda: _packed(
        {"saved_unix_s": 1e9, "state": _kept()},
        {"saved_unix_s": 1e9, "state": {"z": HUGE}},
        {"saved_unix_s": 1e9, "state": {**_kept(), "taken_s": 1e308}},
    ),
    "arrays": _archives,
    "configuration": lambda: [
        (ROOT / "skin.toml").read_bytes(),
        b'[skins.a]\nport = "stub"\nbundle = "x"\nrtia_ohm = nan',
    ],
    "manifest": _manifests,
    "law": lambda: [b'{"newtons_per_siemens": 10.0, "most_n": 5.0}', b'{"newtons_per_siemens": NaN}', b"[" * 3000],
    "presses": lambda: [
        b"force_n,x_m,y_m,pressure_n,peak_s_per_m,integral_s_m\n1,0,0,1,0.1,1e-6\n",
        b"force_n,row\n1,1e400\n",
    ],
}  # fmt: skip
