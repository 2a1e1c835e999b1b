"""WIRE.md is current, its example works as printed, and the package stands alone under its installed name."""

import dataclasses
import os
import re
import shutil
import subprocess
import sys
import time
from pathlib import Path

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
        assert f"{message.number:#04x} {message.__name__}" in text
    for reason in frames.REASONS:
        assert f"`{reason}`" in text


def test_the_example_prints_contacts(runtime, context):
    code = re.search(r"```python\n(.*?)```", wire_doc.WIRE_MD.read_text(), re.DOTALL)[1]
    publisher = Publisher("publisher", context)
    process = subprocess.Popen([sys.executable, "-uc", code], stdout=subprocess.PIPE, text=True, env=dict(os.environ))
    try:
        subscribed(publisher)
        publisher.send(ContactFrame(skin="palm", valid=True, contacts=[Contact(id=1, position=[0.02, -0.01, 0.0])]))
        assert process.stdout.readline() == "0 True [[0.02, -0.01, 0.0]]\n"
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
        "try: ContactSubscriber('palm').latest()\n"
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
