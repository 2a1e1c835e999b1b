"""A scale under the stub, as a stranger would write it: pyzmq and msgpack, nothing of the project.

    python reference_publisher.py RUNTIME_FOLDER JSON

Reads the stub's truth and publishes what a scale would say of it. JSON: scale, offset [N], noise [N], delay_s (stamps
are later by it), late_s (messages too), drop (share of messages that are lost), silent_s (every ten seconds), say
(force instead of the truth's), turn (sign). A line of JSON on its input changes them.
"""

import json
import random
import sys
import threading
import time
from pathlib import Path

import msgpack
import zmq

folder, how = sys.argv[1], json.loads(sys.argv[2])
context = zmq.Context()
truth, out = context.socket(zmq.SUB), context.socket(zmq.PUB)
truth.connect(f"ipc://{folder}/stub.ipc")
truth.subscribe(b"truth/palm\0")
out.bind(f"ipc://{folder}/reference.ipc")
boot = Path("/proc/sys/kernel/random/boot_id").read_text().strip().replace("-", "")
session, seq = f"{random.getrandbits(64):016x}", 0
before, waiting = None, []


def orders():
    for line in sys.stdin:
        how.update(json.loads(line))


def told(sample, force):
    global seq
    message = {
        "schema": 2,
        "skin": "palm",
        "session": session,
        "seq": seq,
        "host": boot,
        "stamps": {"sample": int(sample)},
        "sample_sigma_ns": 1_000_000,
        "source": "board",
        "valid": True,
        "force_n": force,
    }
    seq += 1
    return b"reference/palm\0" + msgpack.packb(message)


threading.Thread(target=orders, daemon=True).start()
while True:
    if truth.poll(2):
        frame = msgpack.unpackb(truth.recv().split(b"\0", 1)[1])
        now = frame["stamps"]["sample"], sum(t["force_n"] or 0.0 for t in frame["touches"])
        if before is not None:
            for k in range(1, 6):  # five readings for each scan
                at = before[0] + (now[0] - before[0]) * k / 5
                force = before[1] + (now[1] - before[1]) * k / 5
                waiting.append((at + 1e9 * how.get("delay_s", 0.0), force))
        before = now
    while waiting and time.monotonic_ns() >= waiting[0][0] + 1e9 * how.get("late_s", 0.0):
        sample, force = waiting.pop(0)
        force = how.get("turn", 1) * how.get("scale", 1.0) * force + how.get("offset", 0.0)
        force += random.gauss(0.0, how.get("noise", 0.0))
        if how.get("say") is not None:
            force = float(how["say"])
        message = told(sample, force)
        lost = random.random() < how.get("drop", 0.0) or time.monotonic() % 10 < how.get("silent_s", 0.0)
        if not lost:
            out.send(message)
