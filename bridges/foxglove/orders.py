"""Services that Foxglove's users may call: tare, record, snapshot; press and fault where the board is the stub. Each
asks for the token, which only who started the bridge has seen: other users of this host reach its port too.
"""

from __future__ import annotations

import hmac
import json
from collections.abc import Callable
from typing import Any

from foxglove import MessageSchema, Schema, Service, ServiceRequest, ServiceSchema

from bridges.process import BridgedSkin
from protocol.control import ControlClient, ControlError
from protocol.topics import RECORDER

TARE_S = 10.0
STUB_S = 3.0
RECORDER_S = 5.0
MOST_BYTES = 4096

_NUMBER = {"type": "number"}


def services(skins: dict[str, BridgedSkin], token: str) -> list[Service]:
    """The services of all skins."""
    found = [
        _service("/record", {"on": {"type": "boolean"}}, token, _record),
        _service("/snapshot", {"before_s": _NUMBER, "after_s": _NUMBER}, token, _snapshot),
    ]
    for name, skin in skins.items():
        found.append(_service(f"/{name}/tare", {}, token, _tare(name)))
        if skin.stub:
            pressed = {key: _NUMBER for key in ("x", "y", "force", "radius", "seconds")}
            found.append(_service(f"/{name}/press", pressed, token, _press(name)))
            fault = {"name": {"type": "string"}, "seconds": _NUMBER}
            found.append(_service(f"/{name}/fault", fault, token, _fault(name)))
    return found


def _record(asked: dict[str, Any]) -> dict[str, Any]:
    return _recorder("record", asked)


def _snapshot(asked: dict[str, Any]) -> dict[str, Any]:
    return _recorder("snapshot", asked)


def _recorder(command: str, args: dict[str, Any]) -> dict[str, Any]:
    """One recorder is for all skins."""
    try:
        return ControlClient(RECORDER, RECORDER_S).call(command, **args)
    except ControlError as why:
        if why.kind != "unreachable":
            raise
        raise ValueError("no recorder runs: [recorder] in skin.toml has `skin up` start one") from None


def _tare(skin: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    return lambda _: ControlClient("preprocessing", TARE_S).call("tare", skin=skin)


def _press(skin: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    def press(asked: dict[str, Any]) -> dict[str, Any]:
        given = {"radius": 0.01, "seconds": 3.0, "shape": "circle", **asked}
        return ControlClient("stub", STUB_S).call("press", skin=skin, **given)

    return press


def _fault(skin: str) -> Callable[[dict[str, Any]], dict[str, Any]]:
    def fault(asked: dict[str, Any]) -> dict[str, Any]:
        seconds = asked.get("seconds", 3.0)
        return ControlClient("stub", STUB_S).call(
            "faults", skin=skin, name=asked["name"], args={}, clear=False, seconds=seconds
        )

    return fault


def _service(
    name: str, properties: dict[str, Any], token: str, act: Callable[[dict[str, Any]], dict[str, Any]]
) -> Service:
    asked = {"type": "object", "properties": {"token": {"type": "string"}, **properties}}
    said = {"type": "object", "properties": {"success": {"type": "boolean"}, "message": {"type": "string"}}}
    schema = ServiceSchema(name, request=_schema("request", asked), response=_schema("response", said))
    return Service(name, schema=schema, handler=lambda request: answer(request, token, set(properties), act))


def _schema(name: str, what: dict[str, Any]) -> MessageSchema:
    data = json.dumps(what).encode()
    return MessageSchema(encoding="json", schema=Schema(name=name, encoding="jsonschema", data=data))


def answer(
    request: ServiceRequest, token: str, known: set[str], act: Callable[[dict[str, Any]], dict[str, Any]]
) -> bytes:
    """Carry out what is asked, where it brings the token; what went wrong is in the answer."""
    try:
        if len(request.payload) > MOST_BYTES:
            raise ValueError(f"found {len(request.payload)} bytes, expected at most {MOST_BYTES}")
        asked = json.loads(request.payload or b"{}")
        if not isinstance(asked, dict):
            raise ValueError("expected a JSON object")
        given = str(asked.pop("token", ""))
        if not hmac.compare_digest(given.encode(), token.encode()):
            raise ValueError('the token is missing or wrong: "token" is in the address that the bridge printed')
        if unknown := asked.keys() - known:
            raise ValueError(f"unknown: {', '.join(sorted(unknown))}; expected some of {', '.join(sorted(known))}")
        done = act(asked)
        said = {"success": True, "message": json.dumps(done, default=str)[:MOST_BYTES]}
    except KeyError as missing:
        said = {"success": False, "message": f"{missing} is missing"}
    except (ValueError, RecursionError, ControlError) as why:
        said = {"success": False, "message": str(why)}
    return json.dumps(said).encode()
