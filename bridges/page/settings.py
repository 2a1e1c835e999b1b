"""What the page is told: a JSON map, checked before anything starts."""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

from protocol.errors import EitskinError
from protocol.frame_types import NAME

LOOPBACK = ("127.0.0.1", "::1", "localhost")


class PageSettingsError(EitskinError, ValueError):
    """The settings cannot be used: says which key, what was found, what is expected."""


@dataclass(frozen=True)
class PageSettings:
    """`skins`: which to show. `host`, `port`: where to listen, or on the first free port of the 20 from there on.
    `names`: host names beside those of the loopback under which browsers may ask for the page. `recordings`: folder of
    what the page's button records; none: no button.
    """

    skins: tuple[str, ...]
    host: str = "127.0.0.1"
    port: int = 8080
    names: tuple[str, ...] = ()
    recordings: str = "recordings"

    @property
    def local(self) -> bool:
        """Whether only this host's browsers reach the page."""
        return self.host in LOOPBACK


def read(text: str) -> PageSettings:
    """The settings in a JSON map. Raises PageSettingsError."""
    try:
        given = json.loads(text)
    except (ValueError, RecursionError) as why:
        raise PageSettingsError(f'the settings are not JSON ({why}): expected {{"skins": ["palm"]}}') from None
    if not isinstance(given, dict):
        raise PageSettingsError(f"the settings are {_shown(given)}, expected a map with the key skins")
    known = {field.name for field in fields(PageSettings)}
    if unknown := sorted(set(given) - known):
        raise PageSettingsError(f"unknown key {', '.join(unknown)}: allowed are {', '.join(sorted(known))}")
    skins = _names(given, "skins", NAME)
    if not skins:
        raise PageSettingsError('skins: found none, expected the names of those to show, as ["palm"]')
    port = given.get("port", 8080)
    if type(port) is not int or not 1 <= port <= 65515:
        raise PageSettingsError(f"port: found {_shown(port)}, expected a number from 1 to 65515")
    for key in ("host", "recordings"):
        if not isinstance(given.get(key, ""), str):
            raise PageSettingsError(f"{key}: found {_shown(given[key])}, expected text")
    return PageSettings(
        skins,
        given.get("host") or "127.0.0.1",
        port,
        _names(given, "names", r"[A-Za-z0-9.\-]{1,253}"),
        given.get("recordings", "recordings"),
    )


def _names(given: dict[str, Any], key: str, form: str) -> tuple[str, ...]:
    found = given.get(key, [])
    if not isinstance(found, list) or not all(isinstance(name, str) and re.fullmatch(form, name) for name in found):
        raise PageSettingsError(f"{key}: found {_shown(found)}, expected a list of names")
    return tuple(found)


def _shown(value: Any) -> str:
    return repr(value)[:80]


def three_folder(prefix: str) -> Path:
    """Where `make venv` puts three.js: in the virtual environment with this prefix."""
    return Path(prefix) / "share" / "eitskin-page"
