"""Messages and files that were changed, cut or made by somebody else: refused or left out, never believed.

`frames` counts the inputs, `refused_%` those that were refused; a promise is broken where a decoder raises anything but
its own error, or gives out something else than was put in without saying so.
"""

from __future__ import annotations

import io
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path

import msgpack
import numpy as np

from bench.stability.run import Row, Setting
from models.bundle import Bundle, BundleError
from models.files import FileError
from models.npz import npz
from protocol.errors import EitskinError
from protocol.frames import FrameError, RawFrame, pack, unpack
from protocol.link import Decoder, ScanFrame, encode
from services.recordings.recording import RecordingError, RecordingReader, RecordingWriter
from services.runtime import persistence

SIZES = {"quick": 100, "full": 2000}
SHAPES: tuple[list[int], ...] = (
    [2**40, 2**40, 0],
    [0, 2**63],
    [2**62, 2**62],
    [-1],
    [2**64 - 1],
    [120, 0],
    [0] * 9,
    [1] * 9,
    [],
    [119],
    [121],
)

Feed = Callable[[bytes], object]
"""Whether bytes were refused: False, None or 0; anything else where something was read. Raises Broken."""


class Broken(EitskinError):
    """A promise was broken: how."""


def changed(data: bytes, rng: np.random.Generator) -> bytes:
    """Between one and eight bytes other than they were, or the end cut off."""
    if rng.random() < 0.2:
        return data[: rng.integers(len(data))]
    out = bytearray(data)
    for at in rng.choice(len(out), min(len(out), int(rng.integers(1, 9))), replace=False):
        out[at] ^= int(rng.integers(1, 256))
    return bytes(out)


def case(name: str, inputs: list[bytes], feed: Feed) -> Row:
    broken: Counter[str] = Counter()
    refused = 0
    for data in inputs:
        try:
            refused += not feed(data)
        except Broken as how:
            broken[str(how)] += 1
        except Exception as error:  # the promise is that there is none
            broken[f"crash: {type(error).__name__}: {str(error)[:60]}"] += 1
    return {"case": name, "frames": len(inputs), "refused_%": 100 * refused / len(inputs), "broken": dict(broken)}


def message(data: bytes) -> object:
    try:
        return pack(unpack(data))
    except FrameError:
        return None


def messages(setting: Setting) -> Iterator[Row]:
    """What a stage's socket may bring: a message has no checksum, so one whose numbers were changed is data."""
    rng, n = setting.rng("messages"), SIZES["quick" if setting.quick else "full"]
    z0 = setting.bundle.z0
    raw = RawFrame(skin="palm", z=z0.astype("c8"), status=np.zeros(len(z0), "u1"))
    packed = pack(raw)
    yield case("a raw frame, bytes changed", [changed(packed, rng) for _ in range(n)], message)
    head, _, fields = packed.partition(b"\0")
    known = msgpack.unpackb(fields)
    arrays = [{"dtype": "<c8", "shape": shape, "data": b""} for shape in SHAPES]
    hostile = [head + b"\0" + msgpack.packb({**known, "z": array}) for array in arrays]
    yield _all_refused(case("arrays of shapes that cannot be", hostile, message))
    yield case("random bytes behind a topic", [head + b"\0" + rng.bytes(200) for _ in range(n)], message)


def link(setting: Setting) -> Iterator[Row]:
    """The serial line has a checksum: nothing that was changed comes out."""
    rng, n = setting.rng("link"), SIZES["quick" if setting.quick else "full"]
    z = setting.bundle.z0.astype("c8")
    line = encode(ScanFrame(seq=7, device_us=1, duration_us=1, config=1, z=z, status=np.zeros(len(z), "u1")))

    def feed(data: bytes) -> object:
        found = Decoder().feed(data + b"\0")
        if found and not (isinstance(found[0], ScanFrame) and np.array_equal(found[0].z, z) and found[0].seq == 7):
            raise Broken("a changed frame was believed")
        return found

    yield case("a frame on the line, bytes changed", [changed(line, rng) for _ in range(n)], feed)


def files(setting: Setting) -> Iterator[Row]:
    """Kept state, manifest, recording and npz have checksums too."""
    n = SIZES["quick" if setting.quick else "full"] // 2
    before = os.environ.get("EITSKIN_RUNTIME")
    with tempfile.TemporaryDirectory(prefix="eit", dir="/tmp") as folder:
        os.environ["EITSKIN_RUNTIME"] = folder
        try:
            for make in (_state, _manifest, _recording, _archive):
                yield make(setting, Path(folder), n)
        finally:
            os.environ.pop("EITSKIN_RUNTIME")
            if before is not None:
                os.environ["EITSKIN_RUNTIME"] = before


def _state(setting: Setting, folder: Path, n: int) -> Row:
    rng = setting.rng("state")
    folder.chmod(0o700)
    persistence.save("bench", "palm", {"z0": setting.bundle.z0})
    file = folder / "state" / "bench-palm.msgpack"
    good = file.read_bytes()
    level = persistence.log.level
    persistence.log.setLevel("CRITICAL")  # it names every one of them

    def feed(data: bytes) -> object:
        file.write_bytes(data)
        if persistence.restore("bench", "palm") is not None:
            raise Broken("a changed state was believed")
        return None

    try:
        return case("kept state, bytes changed", [changed(good, rng) for _ in range(n)], feed)
    finally:
        persistence.log.setLevel(level)


def _manifest(setting: Setting, folder: Path, n: int) -> Row:
    rng, path = setting.rng("manifest"), folder / "bundle"
    shutil.copytree(setting.bundle.path, path)
    good = (path / "manifest.json").read_bytes()

    def feed(data: bytes) -> object:
        (path / "manifest.json").write_bytes(data)
        try:
            Bundle.load(path)
        except BundleError:
            return None
        raise Broken("a changed manifest was believed")

    return case("a bundle's manifest, bytes changed", [changed(good, rng) for _ in range(n)], feed)


def _recording(setting: Setting, folder: Path, n: int) -> Row:
    rng, path = setting.rng("recording"), folder / "a.mcap"
    sent = [rng.bytes(100) for _ in range(20)]
    with RecordingWriter(path) as writer:
        for k, data in enumerate(sent):
            writer.write("raw/palm", data, k)
            writer.flush()
    good, known = path.read_bytes(), set(sent)

    def feed(data: bytes) -> object:
        path.write_bytes(data)
        try:
            found = [message.data for message in RecordingReader(path).messages()]
        except RecordingError:
            return None
        if not known.issuperset(found):
            raise Broken("a changed message was believed")
        return found

    return case("a recording, bytes changed", [changed(good, rng) for _ in range(n)], feed)


def _archive(setting: Setting, folder: Path, n: int) -> Row:
    rng, out = setting.rng("archive"), io.BytesIO()
    values = rng.standard_normal((8, 20))
    np.savez_compressed(out, measurements=values)
    good = out.getvalue()

    def feed(data: bytes) -> object:
        try:
            found = npz(io.BytesIO(data), "bench.npz")
        except FileError:
            return None
        if any(not np.array_equal(array, values) for array in found.values()):
            raise Broken("a changed array was believed")
        return found

    return case("an npz, bytes changed", [changed(good, rng) for _ in range(n)], feed)


def _all_refused(row: Row) -> Row:
    if row["refused_%"] < 100 and not row["broken"]:
        row["broken"] = {"a message that cannot be was believed": 1}
    return row


PARTS: dict[str, Callable[[Setting], Iterator[Row]]] = {
    "messages of others": messages,
    "the line, changed": link,
    "files, changed": files,
}
