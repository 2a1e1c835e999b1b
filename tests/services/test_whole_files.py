"""What writes a file leaves what was there where that fails: at any step, for any reason, with nothing beside it."""

import errno
import os
from collections.abc import Callable
from pathlib import Path

import pytest

from bench.json_file import write_json
from protocol import whole_file
from protocol.keys import write_keys
from services.calibration import presses_csv
from services.recordings import golden
from services.runtime import persistence

REASONS = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EACCES, errno.EIO, errno.EFBIG)
WRITERS = {
    "text": lambda at: whole_file.write_whole(at / "a.txt", "new"),
    "through a link": lambda at: whole_file.write_whole(at / "link", "new"),
    "keys": lambda at: write_keys(at, "one"),
    "golden": lambda at: golden.accept(at / "a.mcap", []),
    "presses": lambda at: presses_csv.write(at / "a.csv", []),
    "report": lambda at: write_json(at / "a.json", {}),
}


def tree(at: Path) -> dict[str, tuple[bytes, int]]:
    return {path.name: (path.read_bytes(), path.lstat().st_mode) for path in at.iterdir() if path.is_file()}


def refusing(number: int) -> Callable[..., None]:
    def refuse(*_: object, **__: object) -> None:
        raise OSError(number, os.strerror(number))

    return refuse


@pytest.mark.parametrize("step", ["fsync", "replace"])
@pytest.mark.parametrize("writer", WRITERS)
def test_what_was_there_stays_and_the_error_names_the_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, writer: str, step: str
) -> None:
    for name in ("a.txt", "one.key", "one.key_secret", "a.golden", "a.csv", "a.json"):
        (tmp_path / name).write_text("good")
    (tmp_path / "link").symlink_to(tmp_path / "a.txt")
    before = tree(tmp_path)
    for number in REASONS:
        with monkeypatch.context() as fails:
            fails.setattr(whole_file.os, step, refusing(number))
            with pytest.raises(OSError) as found:
                WRITERS[writer](tmp_path)
        assert found.value.errno == number and Path(found.value.filename).parent == tmp_path
        assert tree(tmp_path) == before
    WRITERS[writer](tmp_path)
    assert tree(tmp_path) != before and tree(tmp_path).keys() == before.keys() and (tmp_path / "link").is_symlink()


def test_a_state_that_cannot_be_kept_is_said_and_the_one_before_stays(runtime: Path, monkeypatch) -> None:
    assert persistence.save("preprocessing", "palm", {"n": 1}) == ""
    for step, number in (("replace", errno.ENOSPC), ("open", errno.EROFS), ("replace", errno.EIO)):
        with monkeypatch.context() as fails:
            fails.setattr(persistence.os, step, refusing(number))
            assert os.strerror(number) in persistence.save("preprocessing", "palm", {"n": 2})
        found = persistence.restore("preprocessing", "palm")
        assert found is not None and found[0] == {"n": 1} and len(list((runtime / "state").iterdir())) == 1
