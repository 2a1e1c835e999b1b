"""npz files of anybody: arrays as numpy wrote them, or one clear refusal before memory or time is spent."""

from __future__ import annotations

import io
import os
import struct
import zipfile
from pathlib import Path

import numpy as np
import pytest

from models.files import FileError, read_bytes, read_text
from models.npz import read_npz


def npy(shape: tuple[int, ...], dtype: str, data: bytes) -> bytes:
    """A member whose header says what we like."""
    text = str({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def archive(path: Path, members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> Path:
    with zipfile.ZipFile(path, "w", method) as made:
        for name, content in members.items():
            made.writestr(name, content)
    return path


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_are_read_as_numpy_reads_them(tmp_path: Path, save) -> None:  # type: ignore[no-untyped-def]
    rng = np.random.default_rng(0)
    arrays = {
        "plain": rng.standard_normal((7, 3)),
        "fortran": np.asfortranarray(rng.standard_normal((7, 3))),
        "complex": (rng.standard_normal(5) + 1j).astype("c8"),
        "big_endian": np.arange(5, dtype=">i4"),
        "none": np.zeros((0, 120)),
        "one": np.array(3),
        "text": np.array("model"),
        "flags": np.array([True, False]),
    }
    save(tmp_path / "a.npz", **arrays)
    found = read_npz(tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as theirs:
        assert set(found) == set(theirs.files)
        for name in theirs.files:
            assert np.array_equal(found[name], theirs[name]) and found[name].dtype == theirs[name].dtype
            assert found[name].flags.writeable


BAD = {
    "objects": ({"a.npy": npy((1,), "|O", b"x")}, "is object"),
    "a type that is none": ({"a.npy": npy((1,), "[('x', '<f8')]", bytes(8))}, "no npz of plain arrays"),
    "a shape beyond its bytes": ({"a.npy": npy((2**40,), "<f8", bytes(8))}, "has 8 bytes, expected 8796093022208"),
    "a shape of nothing that overflows": ({"a.npy": npy((2**40, 2**40, 0), "<f8", b"")}, "has 0 bytes, expected 0"),
    "a negative shape": ({"a.npy": npy((-1, -8), "<f8", bytes(64))}, "no npz of plain arrays"),
    "text in an array's place": ({"a.npy": b"hello"}, "no npz of plain arrays"),
    "too many arrays": ({f"{k}.npy": npy((1,), "<f8", bytes(8)) for k in range(300)}, "found 300 arrays"),
}


@pytest.mark.parametrize("name", BAD)
def test_what_is_no_plain_array_is_refused(tmp_path: Path, name: str) -> None:
    members, says = BAD[name]
    with pytest.raises(FileError, match=says):
        read_npz(archive(tmp_path / "a.npz", members))


@pytest.mark.parametrize("method", [zipfile.ZIP_BZIP2, zipfile.ZIP_LZMA])
def test_packings_that_cannot_be_bounded_are_refused(tmp_path: Path, method: int) -> None:
    with pytest.raises(FileError, match="expected deflate"):
        read_npz(archive(tmp_path / "a.npz", {"a.npy": npy((2**17,), "<f8", bytes(2**20))}, method))


def test_what_unpacks_to_far_more_than_measurements_do_is_not_unpacked(tmp_path: Path) -> None:
    path = archive(tmp_path / "a.npz", {"a.npy": npy((5 * 2**20,), "<f8", bytes(5 * 2**23))})
    assert path.stat().st_size < 200_000
    with pytest.raises(FileError, match="unpack to .* no measurements pack so well"):
        read_npz(path)


def test_a_declared_size_that_is_too_small_gives_no_more_than_it(tmp_path: Path) -> None:
    """The directory of the archive says 136 bytes; what is packed there is 32 MB."""
    path = archive(tmp_path / "a.npz", {"a.npy": npy((2**22,), "<f8", bytes(2**25))})
    content = path.read_bytes()
    real = struct.pack("<I", 2**25 + 128)
    assert content.count(real) == 2
    path.write_bytes(content.replace(real, struct.pack("<I", 136)))
    with pytest.raises(FileError):
        read_npz(path)


def test_only_files_are_read_and_only_so_much(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "sparse").touch()
    os.truncate(tmp_path / "sparse", 2**40)
    for name, says in ((".", "a folder"), ("pipe", "a pipe"), ("sparse", "1099511627776 bytes"), ("none", "No such")):
        with pytest.raises(FileError, match=says):
            read_bytes(tmp_path / name, 1000)
    with pytest.raises(FileError, match="a device"):
        read_bytes("/dev/zero", 1000)
    (tmp_path / "text").write_bytes(b"caf\xe9")
    with pytest.raises(FileError, match="not UTF-8"):
        read_text(tmp_path / "text")
    (tmp_path / "marked").write_bytes(b"\xef\xbb\xbfa = 1")
    assert read_text(tmp_path / "marked") == "a = 1"


def test_bytes_of_any_kind_never_raise_anything_else(tmp_path: Path) -> None:
    good = io.BytesIO()
    np.savez_compressed(good, a=np.arange(50.0), b=np.eye(4))
    rng = np.random.default_rng(1)
    for _ in range(300):
        content = bytearray(good.getvalue())
        for at in rng.integers(0, len(content), 3):
            content[at] = rng.integers(256)
        (tmp_path / "a.npz").write_bytes(content[: rng.integers(1, len(content) + 1)])
        try:
            read_npz(tmp_path / "a.npz")
        except FileError as why:
            assert "a.npz" in str(why)
