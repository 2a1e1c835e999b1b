"""A scale under the stub, as a stranger would write it: pyzmq and msgpack, nothing of the project.

    python reference_publisher.py RUNTIME_FOLDER JSON

JSON: scale, offset [N], noise [N], delay_s (stamps are later by it), drop (share of messages that are lost), silent_s
(every ten seconds), say (force instead of the stub's truth). A line of JSON on its input changes them.
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
head = {"schema": 2, "skin": "palm", "session": f"{random.getrandbits(64):016x}", "host": boot, "source": "board"}
head |= {"sample_sigma_ns": 1_000_000, "valid": True}
random, seq = random.Random(1), 0  # noise and losses: the same in each run
before, waiting, began = None, [], time.monotonic()
threading.Thread(target=lambda: [how.update(json.loads(line)) for line in sys.stdin], daemon=True).start()
while True:
    if truth.poll(2):
        frame = msgpack.unpackb(truth.recv().split(b"\0", 1)[1])
        now = frame["stamps"]["sample"], sum(t["force_n"] or 0.0 for t in frame["touches"])
        for k in range(1, 6) if before else ():  # five readings for each scan
            at, force = (a + (b - a) * k / 5 for a, b in zip(before, now, strict=True))
            waiting.append((int(at + 1e9 * how.get("delay_s", 0.0)), force))
        before = now
    while waiting and time.monotonic_ns() >= waiting[0][0]:
        sample, force = waiting.pop(0)
        force = how.get("scale", 1.0) * force + how.get("offset", 0.0) + random.gauss(0.0, how.get("noise", 0.0))
        force = force if how.get("say") is None else float(how["say"])
        message = head | {"seq": seq, "stamps": {"sample": sample}, "force_n": force}
        seq += 1
        if random.random() >= how.get("drop", 0.0) and (time.monotonic() - began) % 10 >= how.get("silent_s", 0.0):
            out.send(b"reference/palm\0" + msgpack.packb(message))
