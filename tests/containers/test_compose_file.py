"""What the compose files grant: no network but where it is needed, no rights but where they are needed."""

from typing import Any

import yaml

from protocol.topics import BRIDGES
from services.runtime.config import load
from tests.needs import ROOT


def services(name: str) -> Any:
    return yaml.safe_load((ROOT / name).read_text())["services"]


def test_no_process_has_a_network_and_the_stub_shares_acquisitions_loopback() -> None:
    modes = {name: service["network_mode"] for name, service in services("docker-compose.yml").items()}
    assert modes.pop("stub") == "service:acquisition"
    bridges = {name: modes.pop(name) for name in ("page", "ros2", "foxglove")}
    assert bridges == {"page": "bridge", "ros2": "host", "foxglove": "bridge"}
    assert set(modes.values()) == {"none"}
    assert services("docker-compose.network-board.yml") == {"acquisition": {"network_mode": "bridge"}}


def test_only_the_helper_is_root_and_it_only_hands_folders_over() -> None:
    for name, service in services("docker-compose.yml").items():
        assert service["cap_drop"] == ["ALL"] and service["read_only"] is True, name
        assert service["security_opt"] == ["no-new-privileges:true"], name
        if name != "runtime":
            assert "cap_add" not in service and service["user"].startswith("${EITSKIN_UID"), name
    helper = services("docker-compose.yml")["runtime"]
    assert helper["cap_add"] == ["CHOWN", "FOWNER"] and helper["command"][:3] == ["python", "-m", "services.folders"]
    mounted = {volume.rpartition(":")[2]: volume.rpartition(":")[0] for volume in helper["volumes"]}
    assert dict(argument.split("=", 1) for argument in helper["command"][4:]) == mounted


def test_a_bridge_runs_only_where_its_profile_is_named_and_is_seen_by_its_host_alone() -> None:
    found = services("docker-compose.yml")
    for name in BRIDGES:
        assert found[name]["profiles"] == [name]
        assert found[name]["command"][:4] == ["python", "-m", "services.bridge", name]
    assert found["ros2"]["profiles"] == ["ros2"] and found["ros2"]["build"] == {"context": ".", "target": "ros2"}
    assert found["foxglove"]["build"] == {"context": ".", "target": "bridge", "args": {"BRIDGE": "foxglove"}}
    assert (ROOT / "requirements" / "foxglove.lock").is_file()
    for name, port in (("page", "${EITSKIN_PAGE_PORT:-8080}"), ("foxglove", "8765")):
        assert found[name]["ports"] == [f"127.0.0.1:{port}:{port}"]
        assert found[name]["command"][4:] == ["--host", "0.0.0.0", "--port", port], "whatever skin.toml says"
    assert {name for name, service in found.items() if "ports" in service} == {"page", "foxglove"}
    inside = "/opt/eitskin/" + load(ROOT / "skin.toml").page.recordings
    assert f"${{EITSKIN_RECORDINGS:-./recordings}}:{inside}" in services("docker-compose.yml")["page"]["volumes"]
