"""npz files of anybody: arrays as numpy wrote them, or one clear refusal before memory or time is spent."""

import os
import struct
import zipfile

import numpy as np
import pytest

from models.files import FileError, read_bytes
from models.npz import read_npz


def npy(shape, dtype, data):
    """A member whose header says what we like."""
    text = str({"descr": dtype, "fortran_order": False, "shape": shape}).encode()
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + data


def archive(path, members, method=zipfile.ZIP_DEFLATED):
    with zipfile.ZipFile(path, "w", method) as made:
        for name, content in members.items():
            made.writestr(name, content)
    return path


def test_arrays_are_read_as_numpy_reads_them(tmp_path):
    values = np.random.default_rng(0).standard_normal((7, 3))
    arrays = {"fortran": np.asfortranarray(values), "complex": (values + 1j).astype("c8"), "one": np.array(3)}
    arrays |= {"big_endian": np.arange(5, dtype=">i4"), "none": np.zeros((0, 120)), "text": np.array("model")}
    for save in (np.savez, np.savez_compressed):
        save(tmp_path / "a.npz", **arrays)
        found = read_npz(tmp_path / "a.npz")
        assert set(found) == set(arrays)
        for name, array in arrays.items():
            assert np.array_equal(found[name], array) and found[name].dtype == array.dtype


DENSE, MANY = npy((5 * 2**20,), "<f8", bytes(5 * 2**23)), {f"{k}.npy": b"" for k in range(300)}
WRONG = {
    "is object": {"a.npy": npy((1,), "|O", b"x")},
    "has 8 bytes, expected 8796093022208": {"a.npy": npy((2**40,), "<f8", bytes(8))},
    "no npz of plain arrays": {"a.npy": b"hello"},
    "found 300 arrays": MANY,
    "unpack to .* no measurements pack so well": {"a.npy": DENSE},
}


def test_what_is_no_plain_array_is_refused(tmp_path):
    for says, members in WRONG.items():
        with pytest.raises(FileError, match=says):
            read_npz(archive(tmp_path / "a.npz", members))
    with pytest.raises(FileError, match="expected deflate"):
        read_npz(archive(tmp_path / "a.npz", {"a.npy": npy((2**17,), "<f8", bytes(2**20))}, zipfile.ZIP_LZMA))
    np.save(tmp_path / "a.npy", np.ones(3))
    with pytest.raises(FileError, match="one bare array, expected named ones"):
        read_npz(tmp_path / "a.npy")
    path = archive(tmp_path / "a.npz", {"a.npy": npy((2**22,), "<f8", bytes(2**25))})
    content, real = path.read_bytes(), struct.pack("<I", 2**25 + 128)
    assert content.count(real) == 2
    path.write_bytes(content.replace(real, struct.pack("<I", 136)))  # its directory lies: 32 MB are packed there
    with pytest.raises(FileError):
        read_npz(path)


def test_only_files_are_read_and_only_so_much(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "sparse").touch()
    os.truncate(tmp_path / "sparse", 2**40)
    for name, says in ((".", "a folder"), ("pipe", "a pipe"), ("sparse", "1099511627776 bytes"), ("none", "No such")):
        with pytest.raises(FileError, match=says):
            read_bytes(tmp_path / name, 1000)
