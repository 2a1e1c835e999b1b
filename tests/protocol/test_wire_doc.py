"""WIRE.md is current, its example works as printed, and the package stands alone under its installed name."""

import dataclasses
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from protocol import frames, link, topics, wire_doc
from protocol.frames import Contact, ContactFrame
from protocol.sockets import Publisher

from .test_sockets import subscribed

PROTOCOL = Path(wire_doc.__file__).parent


def test_wire_md_is_current():
    have = wire_doc.WIRE_MD.read_text()
    assert wire_doc.generate(have) == have, "run python -m protocol.wire_doc"


def test_wire_md_names_every_topic_key_and_message():
    text = wire_doc.WIRE_MD.read_text()
    for topic in topics.TOPICS.values():
        assert f"`{topic.name}/SKIN`" in text
        for field in dataclasses.fields(topic.frame):
            assert f"| `{field.name}` |" in text
    for message in link.MESSAGES:
        assert f"{message.number:#04x} {message.wire_name}" in text
    for reason in frames.REASONS:
        assert f"`{reason}`" in text


@pytest.mark.parametrize("document", [wire_doc.WIRE_MD, PROTOCOL.parent / "README.md"], ids=lambda path: path.name)
@pytest.mark.parametrize("variable", ["EITSKIN_RUNTIME", "XDG_RUNTIME_DIR"])
def test_the_ten_lines_print_contacts_and_when_not_to_act(document, variable, runtime, context, monkeypatch):
    """In the folder where the service puts its sockets, also on a desktop, which sets the second variable."""
    monkeypatch.delenv("EITSKIN_RUNTIME")
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(runtime))
    if variable == "EITSKIN_RUNTIME":
        monkeypatch.setenv(variable, f"{runtime}/here")
    code = re.search(r"```python\n(import msgpack.*?)```", document.read_text(), re.DOTALL)[1]
    publisher = Publisher("publisher", context)
    process = subprocess.Popen([sys.executable, "-uc", code], stdout=subprocess.PIPE, text=True, env=dict(os.environ))
    try:
        subscribed(publisher)
        now = time.monotonic_ns()
        for n, (valid, sample) in enumerate(((True, now), (False, now), (True, now - 60 * 10**9), (True, 2 * now))):
            contact = Contact(id=1, position=[0.02, -0.01, 0.0], force_n=1.0)
            stamps = {"sample": sample, "publish": now}
            frame = ContactFrame(skin="palm", scan=n, valid=valid, valid_for_s=30.0, stamps=stamps, contacts=[contact])
            publisher.send(frame)
            assert process.stdout.readline() == f"{n} {n == 0} [([0.02, -0.01, 0.0], 1.0)]\n"
        assert process.wait(30) == 0, "silence"
    finally:
        process.kill()
        process.communicate()


def test_the_package_stands_alone_as_eitskin(runtime, tmp_path):
    """As the wheel lays it out: the folder under another name, and nothing else of the project in reach."""
    shutil.copytree(PROTOCOL, tmp_path / "eitskin", ignore=shutil.ignore_patterns("__pycache__"))
    code = (
        "import pkgutil, importlib, sys, eitskin\n"
        "for m in pkgutil.iter_modules(eitskin.__path__): importlib.import_module('eitskin.' + m.name)\n"
        "assert not {'protocol', 'services', 'models'} & set(sys.modules)\n"
        "from eitskin.client import ContactSubscriber, Stale\n"
        "try: ContactSubscriber('palm').latest(wait_s=0)\n"
        "except Stale as stale: print(stale)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=30,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
    )  # fmt: skip
    assert done.stdout.startswith("no contact frame of palm yet"), done.stderr


def test_packing_and_unpacking_cost_little():
    """Well under a tenth of a millisecond here; ten times that is a defect on any machine."""
    import numpy as np

    contact = ContactFrame(skin="palm", contacts=[Contact(id=1, position=[0.0, 0.0, 0.0])])
    raw = frames.RawFrame(skin="palm", z=np.ones(120), status=np.zeros(120))
    for frame in (contact, raw):
        best = min(timed(lambda f=frame: frames.unpack(frames.pack(f))) for _ in range(50))
        assert best < 1e-3


def timed(call):
    began = time.perf_counter()
    call()
    return time.perf_counter() - began
