"""The URLs of pyserial that a skin's `port` may be, checked before one is opened."""

from __future__ import annotations

import importlib
import re
from collections.abc import Callable
from urllib.parse import parse_qsl, urlsplit

BY_NAME = "hwgrep://"
LEVELS = ("debug", "info", "warning", "error")


def _number(text: str) -> bool:
    return re.fullmatch(r"\d+(\.\d+)?", text) is not None


def _level(text: str) -> bool:
    return text in LEVELS


def _any(text: str) -> bool:
    return text.isprintable()


Options = dict[str, Callable[[str], bool]]
FORMS: dict[str, tuple[str, Options]] = {  # kind -> its form, and the options that may follow it
    "socket": ("socket://HOST:PORT", {"logging": _level}),
    "rfc2217": (
        "rfc2217://HOST:PORT",
        {"logging": _level, "ign_set_control": _any, "poll_modem": _any, "timeout": _number},
    ),
    "hwgrep": (
        "hwgrep:// and a regular expression that a port's name matches",
        {"n": lambda text: text.isdigit() and int(text) > 1, "skip_busy": _any},
    ),
    "spy": ("spy:///dev/ttyACM0", {"file": str.isprintable, "color": _any, "raw": _any, "all": _any}),
    "alt": ("alt:///dev/ttyACM0", {"class": lambda text: text in ("Serial", "PosixPollSerial", "VTIMESerial")}),
    "loop": ("loop://", {"logging": _level}),
    "cp2110": ("cp2110:// and the path of the USB device", {}),
}


def check(port: str) -> None:
    """Raises ValueError, whose text is the form that was expected and what is wrong, for what no port can be."""
    kind = port.partition("://")[0].lower()
    if kind not in FORMS:
        forms = ", ".join(form.partition(" ")[0] for form, _ in FORMS.values())
        raise ValueError(f"a pyserial URL, one of {forms} (found the kind {kind!r})")
    form, options = FORMS[kind]
    wrong = _by_name(port, options) if kind == "hwgrep" else _url(port, kind, options)
    if wrong:
        raise ValueError(f"{form} ({wrong})")


def _by_name(port: str, options: Options) -> str:
    pattern, *given = port[len(BY_NAME) :].split("&")
    try:
        re.compile(pattern)
    except (re.error, RecursionError, OverflowError) as why:
        return f"found {pattern!r}: {why}"
    if not pattern:
        return "found no expression"
    return _unknown([(key, value) for key, _, value in (one.partition("=") for one in given)], options)


def _url(port: str, kind: str, options: Options) -> str:
    if not port.isprintable() or " " in port:
        return "found a blank or a sign that cannot be printed"
    try:
        parts = urlsplit(port)
        number = parts.port if kind in ("socket", "rfc2217") else None
        (parts.hostname or "").encode("idna")  # as it is asked for
    except ValueError:
        return "found no name or address and a number up to 65535; an address with colons stands in brackets, [::1]"
    if kind in ("socket", "rfc2217"):
        if not parts.hostname or not number or parts.path.strip("/") or "@" in parts.netloc or parts.fragment:
            return f"found the host {parts.hostname or 'missing'}, the port {number or 'missing'}"
    elif kind in ("spy", "alt") and not (parts.netloc + parts.path).startswith("/"):
        return "found no path of a device"
    elif kind == "cp2110":
        try:
            importlib.import_module("serial.urlhandler.protocol_cp2110")
        except ImportError as why:
            return f"it needs a package that is not installed, {why.name}"
    return _unknown(parse_qsl(parts.query, keep_blank_values=True), options)


def _unknown(given: list[tuple[str, str]], options: Options) -> str:
    for key, value in given:
        if key not in options or not options[key](value):
            return f"found {key}={value}; options: {', '.join(options) or 'none'}"
    return ""
