"""What processes ask of the kernel: had where it may be had, said where not; in a process of its own."""

import json
import os
import subprocess
import sys

import pytest

from services.runtime.config import ConfigError, parse
from services.runtime.stage import Health

pytestmark = pytest.mark.live

SKINS = {"palm": {"port": "stub", "bundle": "square16"}}
ASK = """
import json, os, resource, sys
from services.runtime.config_sections import RealTime
from services.runtime.realtime import apply
drop, wanted = json.loads(sys.argv[1])
if drop:
    for limit in (resource.RLIMIT_RTPRIO, resource.RLIMIT_MEMLOCK):
        resource.setrlimit(limit, (0, 0))
    if os.getuid() == 0:
        os.setgroups([])
        os.setresgid(65534, 65534, 65534)
        os.setresuid(65534, 65534, 65534)
refused = apply(RealTime(**wanted), "inference")
locked = next(int(l.split()[1]) for l in open("/proc/self/status") if l.startswith("VmLck"))
print(json.dumps([refused, os.sched_getscheduler(0), sorted(os.sched_getaffinity(0)), locked]))
"""


def ask(wanted: dict, unprivileged: bool) -> tuple[list[str], int, list[int], int]:
    done = subprocess.run(
        [sys.executable, "-c", ASK, json.dumps([unprivileged, wanted])], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    return tuple(json.loads(done.stdout))


def test_nothing_is_asked_by_default():
    refused, policy, cpus, locked = ask({}, unprivileged=True)
    assert refused == [] and policy == os.SCHED_OTHER and locked == 0
    assert cpus == sorted(os.sched_getaffinity(0))


def test_what_is_refused_is_said_and_the_process_goes_on():
    refused, policy, _, locked = ask({"priority": 20, "lock_memory": True}, unprivileged=True)
    assert policy == os.SCHED_OTHER and locked == 0
    assert len(refused) == 2
    assert "real-time priority 20" in refused[0] and "CAP_SYS_NICE" in refused[0]
    assert "memory is not locked" in refused[1] and "CAP_IPC_LOCK" in refused[1]


def test_a_processor_that_is_not_there_is_said():
    refused, _, cpus, _ = ask({"cpus": {"inference": [4000]}}, unprivileged=True)
    assert len(refused) == 1 and "4000" in refused[0] and cpus == sorted(os.sched_getaffinity(0))


@pytest.mark.parametrize("absent", [4000, 2**40])
def test_processors_of_which_some_are_not_there_are_said(absent):
    mine = sorted(os.sched_getaffinity(0))[-1]
    refused, _, cpus, _ = ask({"cpus": {"inference": [mine, absent]}}, unprivileged=True)
    assert len(refused) == 1 and str(absent) in refused[0] and mine in cpus


def test_pinning_needs_no_privilege_and_is_for_the_process_named():
    mine = sorted(os.sched_getaffinity(0))[-1]
    refused, _, cpus, _ = ask({"cpus": {"inference": [mine]}}, unprivileged=True)
    assert refused == [] and cpus == [mine]
    refused, _, cpus, _ = ask({"cpus": {"publisher": [mine]}}, unprivileged=True)
    assert refused == [] and cpus == sorted(os.sched_getaffinity(0))


def test_each_is_had_or_refused_never_neither():
    """As root mostly had; a container may refuse either."""
    refused, policy, _, locked = ask({"priority": 20, "lock_memory": True}, unprivileged=False)
    said = " ".join(refused)
    assert (policy == os.SCHED_FIFO) != ("real-time priority" in said)
    assert (locked > 0) != ("memory is not locked" in said)


@pytest.mark.parametrize(
    ("section", "named"),
    [
        ({"priority": 100}, "realtime.priority"),
        ({"priority": True}, "realtime.priority"),
        ({"lock_memory": "no"}, "realtime.lock_memory"),
        ({"cpus": {"infrence": [0]}}, "infrence"),
        ({"cpus": {"inference": []}}, "inference"),
        ({"cpus": {"inference": [-1]}}, "realtime.cpus"),
    ],
)
def test_a_wrong_section_is_named(section, named):
    with pytest.raises(ConfigError, match=named):
        parse({"skins": SKINS, "realtime": section})


def test_a_problem_of_the_process_makes_its_health_a_warning():
    well = Health("OK", [], {"frames": 3})
    assert well.with_problems([]) is well
    told = well.with_problems(["no real-time priority"])
    assert (told.level, told.messages, told.counters) == ("WARN", ["no real-time priority"], {"frames": 3})
    assert Health("ERROR", ["broken"]).with_problems(["more"]).level == "ERROR"
