"""Recordings in the formats of others, read back by others' readers."""

from __future__ import annotations

import csv
import importlib.util
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from google.protobuf import descriptor_pb2, descriptor_pool, json_format, message_factory
from mcap.reader import make_reader
from mcap_ros2.reader import read_ros2_messages
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from protocol.frames import Contact, ContactFrame, Frame, ImageFrame, InfoFrame, ShapeFrame, StatusFrame, pack
from services.recordings.recording import RecordingWriter
from tests import needs
from tests.cli.conftest import Ran, skin  # noqa: F401

AHEAD_NS = 1_700_000_000_000_000_000  # the time of day, less the monotonic clock
EVERY_NS = 40_000_000
FRAMES = 12
INVALID = (5, 6)

Skin = Callable[..., Ran]


def frames() -> list[tuple[int, Frame]]:
    """(recorded at, frame): twelve scans, of which two are not valid; a touch from the third on, held from the 8th."""
    found: list[tuple[int, Frame]] = []
    told = {"pose": [0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0], "parent_frame_id": "wrist", "frame_id": "palm"}
    found.append((AHEAD_NS, InfoFrame(skin="palm", valid=True, stamps={"publish": 0}, info=told)))
    image = np.zeros((8, 8), "<f4")
    image[4, 6] = 0.3
    for k in range(FRAMES):
        sample = 1_000_000_000 + k * EVERY_NS
        late = 3_000_000 if k == 4 else 1_000_000  # how long it took to be recorded
        head = {
            "skin": "palm",
            "session": "0123456789abcdef",
            "scan": 100 + k,
            "host": "here",
            "source": "board",
            "valid": k not in INVALID,
            "reasons": ["frozen"] if k in INVALID else [],
            "valid_for_s": 0.25,
            "stamps": {"sample": sample, "publish": sample + 30_000_000},
        }
        touch = Contact(id=7, position=[0.02, 0.01, 0], area_m2=3e-4, force_n=3.0, wrench=[0, 0, -3.0, -0.03, 0.06, 0])
        contacts = [touch] if k >= 2 else []
        held = k >= 7
        at = AHEAD_NS + sample + 30_000_000 + late
        shown = np.zeros((0, 0), "<f4") if held or k < 2 else image
        found += [
            (
                at,
                ImageFrame(
                    **head,  # type: ignore[arg-type]
                    touched=k >= 2,
                    held=held,
                    reconstructed=106 if k >= 6 else 100 + k,
                    image=shown,
                    metres_per_pixel=0.01,
                    origin=[-0.04, -0.04],
                ),
            ),
            (at, ContactFrame(**head, frame_id="palm", contacts=contacts, held=held)),  # type: ignore[arg-type]
        ]
        if contacts:
            square = [[0.01, 0.0], [0.03, 0.0], [0.03, 0.02], [0.01, 0.02]]
            found.append(
                (at, ShapeFrame(**head, ids=[7], outlines=[square], orientation=[0.0], probabilities=[[0.2] * 5]))  # type: ignore[arg-type]
            )
    status = StatusFrame(skin="palm", process="publisher", level="WARN", messages=["slow"], stamps={"publish": 10**9})
    found.append((AHEAD_NS + 2_000_000_000, status))
    return found


@pytest.fixture
def recording(tmp_path: Path) -> Path:
    path = tmp_path / "demo.mcap"
    with RecordingWriter(path) as writer:
        for at, frame in frames():
            topic, _, data = pack(frame).partition(b"\0")
            writer.write(topic.decode(), data, at)
        writer.write("contact/palm", b"rubbish", AHEAD_NS)
    return path


def measured_ns(k: int) -> int:
    """When scan k was measured, by the frame that was recorded soonest."""
    return AHEAD_NS + 1_000_000 + 1_000_000_000 + k * EVERY_NS


def test_ros2_is_read_by_mcap_ros2_and_by_rosbags(skin: Skin, recording: Path) -> None:  # noqa: F811
    ran = skin("export", recording, "--ros2")
    assert ran.code == 0, ran.err
    out = recording.with_suffix(".ros2.mcap")
    by_topic: dict[str, list[tuple[int, object]]] = {}
    for message in read_ros2_messages(out):
        by_topic.setdefault(message.channel.topic, []).append((message.log_time_ns, message.ros_msg))
    valid = [k for k in range(FRAMES) if k not in INVALID]
    wrenches = by_topic["/eitskin/palm/wrench"]
    assert [ns for ns, _ in wrenches] == [measured_ns(k) for k in valid]
    stamps = [w.header.stamp.sec * 10**9 + w.header.stamp.nanosec for _, w in wrenches]
    assert stamps == [measured_ns(k) for k in valid]
    assert [w.wrench.force.z for _, w in wrenches] == [-3.0 if k >= 2 else 0.0 for k in valid]
    assert {w.header.frame_id for _, w in wrenches} == {"palm"}
    assert [v.data for _, v in by_topic["/eitskin/palm/valid"]] == [k not in INVALID for k in range(FRAMES)]
    clouds = [c for _, c in by_topic["/eitskin/palm/pressure"]]
    peaks = [float(np.frombuffer(bytes(c.data), "<f4").reshape(-1, 5)[:, 3].max()) for c in clouds]
    assert peaks == [np.float32(0.3) if k >= 2 else 0.0 for k in valid], "a held image is written again"
    (tf,) = by_topic["/tf_static"]
    assert tf[1].transforms[0].child_frame_id == "palm"
    assert by_topic["/diagnostics"][0][1].status[0].message == "slow"
    store = get_typestore(Stores.EMPTY)
    with open(out, "rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None and schema.encoding == "ros2msg" and channel.message_encoding == "cdr"
            assert "offered_qos_profiles" in channel.metadata
            store.register(
                {k: v for k, v in get_types_from_msg(schema.data.decode(), schema.name).items() if k not in store.types}
            )
            found = store.deserialize_cdr(message.data, schema.name)
            assert store.serialize_cdr(found, schema.name).tobytes() == message.data


def test_foxglove_is_read_by_the_schemas_inside(skin: Skin, recording: Path) -> None:  # noqa: F811
    assert skin("export", recording, "--foxglove").code == 0
    by_topic: dict[str, list[tuple[int, dict]]] = {}  # type: ignore[type-arg]
    with open(recording.with_suffix(".foxglove.mcap"), "rb") as file:
        for schema, channel, message in make_reader(file).iter_messages():
            assert schema is not None
            if channel.message_encoding == "json":
                import json

                value = json.loads(message.data)
            else:
                pool = descriptor_pool.DescriptorPool()
                for each in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(each)
                kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
                value = json_format.MessageToDict(kind.FromString(message.data), preserving_proto_field_name=True)
            by_topic.setdefault(channel.topic, []).append((message.log_time, value))
    valid = [k for k in range(FRAMES) if k not in INVALID]
    assert [ns for ns, _ in by_topic["/palm/forces"]] == [measured_ns(k) for k in valid]
    assert [f["force_n"] for _, f in by_topic["/palm/forces"]] == [3.0 if k >= 2 else 0 for k in valid]
    assert [line["message"] for _, line in by_topic["/palm/log"]] == ["valid", "not valid: frozen", "valid"]
    scenes = [s["entities"][0] for _, s in by_topic["/palm/scene"]]
    assert len(scenes[-1]["lines"][0]["points"]) == 4 and "lines" not in scenes[0]
    assert len(by_topic["/palm/image"]) == len(valid)


def test_tables_have_a_row_for_each_contact_and_say_what_was_not_valid(skin: Skin, recording: Path) -> None:  # noqa: F811
    assert skin("export", recording, "--csv").code == 0
    with open(recording.with_suffix(".csv"), newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == FRAMES
    assert [row["time_s"] for row in rows] == [f"{measured_ns(k) / 1e9:.3f}000000" for k in range(FRAMES)]
    assert [row["valid"] for row in rows] == [str(k not in INVALID) for k in range(FRAMES)]
    assert rows[5]["reasons"] == "frozen" and rows[0]["id"] == "" and rows[2]["id"] == "7"
    assert (rows[2]["x_m"], rows[2]["force_n"], rows[2]["tx_nm"]) == ("0.02", "3.0", "-0.03")
    with np.load(recording.with_suffix(".npz")) as arrays:
        assert list(arrays["id"]) == [-1, -1] + [7] * (FRAMES - 2)
        assert np.isnan(arrays["force_n"][:2]).all() and (arrays["force_n"][2:] == 3.0).all()
        assert arrays["valid"].tolist() == [k not in INVALID for k in range(FRAMES)]


def test_what_cannot_be_exported_is_said_in_a_line(skin: Skin, recording: Path, tmp_path: Path) -> None:  # noqa: F811
    assert "found 0 formats" in skin("export", recording).err
    assert "found 2 formats" in skin("export", recording, "--csv", "--ros2").err
    assert "recording itself" in skin("export", recording, "--ros2", "--out", recording, "--overwrite").err
    assert "no frame of sole" in skin("export", recording, "--ros2", "--skin", "sole").err
    assert skin("export", tmp_path / "none.mcap", "--csv").code == 2
    out = recording.with_suffix(".ros2.mcap")
    out.write_bytes(b"mine")
    assert "is there already" in skin("export", recording, "--ros2").err and out.read_bytes() == b"mine"
    assert skin("export", recording, "--ros2", "--overwrite").code == 0 and out.stat().st_size > 1000
    assert not list(tmp_path.glob(".*.part"))
    if importlib.util.find_spec("rerun") is None:
        assert "rerun-sdk" in skin("export", recording, "--rerun").err


def test_rerun_is_read_by_rerun(skin: Skin, recording: Path) -> None:  # noqa: F811
    needs.RERUN.here()
    from rerun import chunk

    assert skin("export", recording, "--rerun").code == 0
    found: dict[str, list[tuple[int, dict[str, Any]]]] = {}
    for part in chunk.RrdReader(str(recording.with_suffix(".rrd"))).stream():
        for row in part.to_record_batch().to_pylist():
            if "measured" in row:
                found.setdefault(part.entity_path, []).append((row["measured"], row))
    for rows in found.values():
        rows.sort(key=lambda row: row[0])

    def at(path: str) -> list[int]:
        return [int(np.datetime64(when, "ns").astype(np.int64)) for when, _ in found[path]]

    def near(k: int) -> Any:
        return pytest.approx(measured_ns(k), abs=1000)  # rerun's rows are read back as datetimes, to the microsecond

    assert at("/palm/contacts") == [near(k) for k in range(FRAMES)] == at("/palm/valid")
    assert [row["Scalars:scalars"] for _, row in found["/palm/valid"]] == [
        [float(k not in INVALID)] for k in range(FRAMES)
    ]
    arrows = [row["Arrows3D:vectors"] for _, row in found["/palm/contacts"]]
    assert [len(each or []) for each in arrows] == [k >= 2 and k not in INVALID for k in range(FRAMES)]
    _, touched = found["/palm/contacts"][3]
    tip = np.add(touched["Arrows3D:origins"], touched["Arrows3D:vectors"])
    assert np.allclose(tip, [[0.02, 0.01, 0.0]], atol=1e-6) and touched["Arrows3D:labels"] == ["7 3.0 N unknown"]
    forces = [row["Scalars:scalars"][0] for _, row in found["/palm/force_n"]]
    assert forces == [0.0, 0.0] + [3.0] * (FRAMES - 2 - len(INVALID))
    image = found["/palm/image"][0][1]
    assert {key: value for key, value in image["DepthImage:format"][0].items() if key in ("width", "height")} == {
        "width": 8,
        "height": 8,
    }
    pixels = np.frombuffer(bytes(image["DepthImage:buffer"][0]), "<f4").reshape(8, 8)
    assert pixels[8 - 1 - 4, 6] == np.float32(0.3) and np.count_nonzero(pixels) == 1  # its rows run downwards
