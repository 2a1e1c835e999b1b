"""Recordings in the formats of others, read back by others' readers."""

import csv
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages

from protocol.frames import Contact, ContactFrame, Frame, ImageFrame, InfoFrame, ShapeFrame, StatusFrame, pack
from services.bridge import NEEDS
from services.recordings.recording import RecordingWriter
from tests import needs
from tests.bridges.conftest import PLACED, SQUARE, drop_image
from tests.bridges.viewer import decoded
from tests.cli.conftest import skin  # noqa: F401

AHEAD_NS = 1_700_000_000_000_000_000  # the time of day, less the monotonic clock
FRAMES, INVALID = 12, (5, 6)
VALID = [k for k in range(FRAMES) if k not in INVALID]
ARE_VALID = [k in VALID for k in range(FRAMES)]
# When a scan was measured, by the frame that was recorded soonest
MEASURED_NS = [AHEAD_NS + 1_000_000 + 1_000_000_000 + k * 40_000_000 for k in range(FRAMES)]


def frames() -> Iterator[tuple[int, Frame]]:
    """(recorded at, frame): twelve scans, of which two are not valid; a touch from the third on, held from the 8th."""
    yield AHEAD_NS, InfoFrame(skin="palm", valid=True, stamps={"publish": 0}, info=PLACED)
    for k in range(FRAMES):
        sample = 1_000_000_000 + k * 40_000_000
        at = AHEAD_NS + sample + 30_000_000 + (3_000_000 if k == 4 else 1_000_000)  # how long it took to be recorded
        head: dict[str, Any] = {"skin": "palm", "session": "0123456789abcdef", "scan": 100 + k, "host": "here"}
        head |= {"source": "board", "valid": k not in INVALID, "reasons": ["frozen"] if k in INVALID else []}
        head |= {"valid_for_s": 0.25, "stamps": {"sample": sample, "publish": sample + 30_000_000}}
        touch = Contact(id=7, position=[0.02, 0.01, 0], area_m2=3e-4, force_n=3.0, wrench=[0, 0, -3.0, -0.03, 0.06, 0])
        contacts, held = [touch] if k >= 2 else [], k >= 7
        shown = np.zeros((0, 0), "<f4") if held or k < 2 else drop_image()
        grid: dict[str, Any] = {"metres_per_pixel": 0.01, "origin": [-0.04, -0.04], "reconstructed": min(100 + k, 106)}
        yield at, ImageFrame(**head, **grid, touched=k >= 2, held=held, image=shown)
        yield at, ContactFrame(**head, frame_id="wrist", contacts=contacts, held=held)
        shape: dict[str, Any] = {"outlines": [SQUARE], "orientation": [0.0], "probabilities": [[0.2] * 5]}
        if contacts:
            yield at, ShapeFrame(**head, **shape, ids=[7])
    status = StatusFrame(skin="palm", process="publisher", level="WARN", messages=["slow"], stamps={"publish": 10**9})
    yield AHEAD_NS + 2_000_000_000, status


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "demo.mcap"
    with RecordingWriter(path) as writer:
        for at, frame in frames():
            topic, _, data = pack(frame).partition(b"\0")
            writer.write(topic.decode(), data, at)
        writer.write("contact/palm", b"rubbish", AHEAD_NS)
    return path


def test_ros2_is_read_by_another_reader_and_has_the_nodes_topics(skin, recording) -> None:  # noqa: F811
    assert skin("export", recording, "--ros2").code == 0
    out = recording.with_suffix(".ros2.mcap")
    of: dict[str, list[Any]] = defaultdict(list)
    for message in read_ros2_messages(out):
        of[message.channel.topic].append(message.ros_msg)
    assert all(len(m.markers) == 1 for m, valid in zip(of["/palm/markers"], ARE_VALID, strict=True) if not valid)
    stamps = [m.header.stamp.sec * 10**9 + m.header.stamp.nanosec for m in of["/palm/contacts"]]
    assert stamps == MEASURED_NS and [m.valid for m in of["/palm/contacts"]] == ARE_VALID
    forces = [[c.force for c in m.contacts] for m in of["/palm/contacts"]]
    assert forces == [[3.0] if k >= 2 and k in VALID else [] for k in range(FRAMES)]
    assert [w.wrench.force.z for w in of["/palm/wrench"]] == [-3.0 if k >= 2 else 0.0 for k in VALID]
    clouds = [np.frombuffer(bytes(c.data), "<f4").reshape(-1, 5) for c in of["/palm/conductivity_drop"]]
    peaks = [np.float32(0.3) if k >= 2 else 0.0 for k in VALID]
    assert [float(points[:, 3].max()) for points in clouds] == peaks, "a held image is written again"
    assert [tf.transforms[0].child_frame_id for tf in of["/tf_static"]] == ["palm"]
    frame_ids = {of[f"/palm/{topic}"][0].header.frame_id for topic in ("contacts", "wrench")}
    assert frame_ids == {"wrist"} and of["/palm/image"][0].header.frame_id == "palm", "contacts_in may be the parent"
    assert of["/diagnostics"][0].status[0].message == "slow"
    with open(out, "rb") as file:
        summary = make_reader(file).get_summary()
        assert summary is not None
        offered = {c.topic: c.metadata["offered_qos_profiles"] for c in summary.channels.values()}
    assert "reliability: best_effort" in offered["/palm/contacts"] and "transient_local" in offered["/tf_static"]


def test_foxglove_is_read_by_the_schemas_inside(skin, recording) -> None:  # noqa: F811
    assert skin("export", recording, "--foxglove").code == 0
    of: dict[str, list[tuple[int, dict[str, Any]]]] = defaultdict(list)
    with open(recording.with_suffix(".foxglove.mcap"), "rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            value = decoded(channel.message_encoding, schema.name, schema.data, message.data)
            of[channel.topic].append((message.log_time, value))
    forces = [(ns, f["force_n"]) for ns, f in of["/palm/forces"]]
    assert forces == [(MEASURED_NS[k], 3.0 if k >= 2 else 0) for k in VALID]
    assert [line["message"] for _, line in of["/palm/log"]] == ["valid", "not valid: frozen", "valid"]
    scenes = [s["entities"][0] for _, s in of["/palm/scene"]]
    assert len(scenes[-1]["lines"][0]["points"]) == 4 and "lines" not in scenes[0]
    assert len(of["/palm/image"]) == len(VALID)


def test_tables_have_a_row_for_each_contact_and_say_what_was_not_valid(skin, recording) -> None:  # noqa: F811
    assert skin("export", recording, "--csv").code == 0
    with open(recording.with_suffix(".csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    told = [(f"{MEASURED_NS[k] / 1e9:.3f}000000", str(k in VALID)) for k in range(FRAMES)]
    assert [(row["time_s"], row["valid"]) for row in rows] == told
    assert rows[5]["reasons"] == "frozen" and rows[0]["id"] == "" and rows[2]["id"] == "7"
    assert (rows[2]["x_m"], rows[2]["force_n"], rows[2]["tx_nm"]) == ("0.02", "3.0", "-0.03")
    with np.load(recording.with_suffix(".npz")) as arrays:
        assert list(arrays["id"]) == [-1, -1] + [7] * (FRAMES - 2) and arrays["valid"].tolist() == ARE_VALID
        assert np.isnan(arrays["force_n"][:2]).all() and (arrays["force_n"][2:] == 3.0).all()


def test_what_cannot_be_exported_is_said_in_a_line(skin, recording) -> None:  # noqa: F811
    out = recording.with_suffix(".ros2.mcap")
    out.write_bytes(b"mine")
    for options, says in (
        ((), "found 0 formats"),
        (("--ros2", "--out", recording, "--overwrite"), "recording itself"),
        (("--ros2",), "is there already"),
    ):
        assert says in skin("export", recording, *options).err
    assert out.read_bytes() == b"mine"
    assert skin("export", recording, "--ros2", "--overwrite").code == 0 and out.stat().st_size > 1000


def test_a_bridge_that_is_missing_is_refused_before_anything_starts(skin, tmp_path, monkeypatch) -> None:  # noqa: F811
    config = tmp_path / "skin.toml"
    monkeypatch.setitem(NEEDS, "foxglove", "no_such_package")
    for name, says in (("foxglove", "make venv EXTRAS=foxglove"), ("ros2", "start it by `ros2 launch")):
        config.write_text(f'bridges = ["{name}"]\n[skins.palm]\nport = "stub"\nbundle = "square16"\n')
        for command in (("up",), ("bridge", name)):
            ran = skin(*command, "--config", config)
            assert ran.code == 2 and says in ran.err and "Traceback" not in ran.err, ran.err


def test_rerun_is_read_by_rerun(skin, recording) -> None:  # noqa: F811
    needs.RERUN.here()
    from rerun import chunk

    assert skin("export", recording, "--rerun").code == 0
    of: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for part in chunk.RrdReader(str(recording.with_suffix(".rrd"))).stream():
        batch = part.to_record_batch()
        if "measured" in batch.schema.names:  # its times as whole numbers: no datetime holds nanoseconds
            times = batch["measured"].cast("int64").to_pylist()
            rows = batch.drop_columns(["log_time", "measured"]).to_pylist()
            of[part.entity_path] += [row | {"measured": at} for row, at in zip(rows, times, strict=True)]
    for rows in of.values():
        rows.sort(key=lambda row: row["measured"])
    assert [row["measured"] for row in of["/palm/contacts"]] == MEASURED_NS
    assert [row["Scalars:scalars"] for row in of["/palm/valid"]] == [[float(valid)] for valid in ARE_VALID]
    arrows = [len(row["Arrows3D:vectors"] or []) for row in of["/palm/contacts"]]
    assert arrows == [k >= 2 and k in VALID for k in range(FRAMES)]
    touched, forces = of["/palm/contacts"][3], [row["Scalars:scalars"][0] for row in of["/palm/force_n"]]
    tip = np.add(touched["Arrows3D:origins"], touched["Arrows3D:vectors"])
    assert np.allclose(tip, [[0.02, 0.01, 0.0]], atol=1e-6) and forces == [0.0, 0.0] + [3.0] * 8
    pixels = np.frombuffer(bytes(of["/palm/image"][0]["DepthImage:buffer"][0]), "<f4").reshape(8, 8)
    assert pixels[8 - 1 - 4, 6] == np.float32(0.3)  # its rows run downwards
