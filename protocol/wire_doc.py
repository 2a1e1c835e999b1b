"""WIRE.md's tables, printed from topics.py, frame_types.py, commands.py and link_messages.py.

python -m protocol.wire_doc            writes them into WIRE.md, between its markers
python -m protocol.wire_doc --check    exits 1 where WIRE.md is not current
"""

from __future__ import annotations

import inspect
import json
import re
import struct
import sys
from collections.abc import Callable, Iterable
from dataclasses import MISSING, Field
from dataclasses import fields as dataclass_fields
from enum import IntEnum
from pathlib import Path
from typing import Any

import numpy as np

from . import commands, fields, frame_types, frames, link, link_messages, publishing, records, runtime, topics

WIRE_MD = Path(__file__).with_name("WIRE.md")


def table(head: Iterable[str], rows: Iterable[Iterable[object]]) -> str:
    """A Markdown table."""
    titles = list(head)
    lines: list[list[object]] = [[*titles], ["---"] * len(titles), *(list(row) for row in rows)]
    return "".join("| " + " | ".join(str(cell).replace("|", "\\|") for cell in line) + " |\n" for line in lines)


def topic_table() -> str:
    """The table of topics."""
    yes = {True: "yes", False: "no"}
    return table(
        ("topic", "frame", "producer", "Hz", "lazy", "latched", "reader behind", "carries"),
        (
            (
                f"`{t.name}/SKIN`",
                t.frame.__name__,
                "every process" if t.producers == topics.OUR_PROCESSES else ", ".join(t.producers),
                f"{t.rate_hz:g}" if t.rate_hz else "on change",
                yes[t.lazy],
                yes[t.latched],
                "takes the newest" if t.behind == "newest" else "reads all",
                t.carries,
            )
            for t in topics.TOPICS.values()
        ),
    )


def field_table(kind: type[Any], below: type[Any] | None = None) -> str:
    """The fields of a frame (less those of `below`), with type, range and unit."""
    known = {f.name for f in dataclass_fields(below)} if below else set()
    rows = []
    for f in dataclass_fields(kind):
        if f.name not in known:
            check: fields.Check = f.metadata["check"]
            rows.append((f"`{f.name}`", check.describe(), unit_of(check), f.metadata["doc"], if_missing(f)))
    return table(("key", "type", "unit", "meaning", "if missing"), rows)


def if_missing(field: Field[Any]) -> str:
    """What a reader takes where a message lacks the field."""
    if not records.may_be_missing(field):
        return "no frame"
    value = field.default if field.default_factory is MISSING else field.default_factory()
    if isinstance(value, np.ndarray):
        return "zeros" if value.size else "empty"
    return "nil" if value is None else json.dumps(value)


def unit_of(check: fields.Check) -> str:
    """The unit of a checker or of what it holds."""
    while not check.unit and hasattr(check, "item"):
        check = check.item
    return check.unit


def frame_tables() -> str:
    """One table per topic, with the records inside a frame beneath it."""
    out = []
    for topic in topics.TOPICS.values():
        out.append(f"### {topic.name}: {topic.frame.__name__}\n\n{inspect.getdoc(topic.frame)}\n\n")
        out.append(field_table(topic.frame, frame_types.Frame))
        if same := getattr(topic.frame, "same_length", ()):
            out.append(f"\nEqually long: {', '.join(f'`{name}`' for name in same)}.\n")
        for f in dataclass_fields(topic.frame):
            item = getattr(f.metadata["check"], "item", None)
            if isinstance(item, records.Record):
                out.append(f"\nEach entry of `{f.name}`:\n\n{field_table(item.kind)}")
        if topic.frame is frames.InfoFrame:
            keys = ((f"`{key}`", meaning) for key, meaning in frames.INFO_KEYS.items())
            out.append(f"\nKeys of `info`:\n\n{table(('key', 'meaning'), keys)}")
        out.append("\n")
    return "".join(out)


def reason_table() -> str:
    """The reasons in use."""
    return table(("reason", "means"), ((f"`{name}`", meaning) for name, meaning in frames.REASONS.items()))


def command_table() -> str:
    """The commands, with their arguments."""
    rows: list[tuple[object, ...]] = []
    for name, command in commands.COMMANDS.items():
        rows.append((f"`{name}`", command.by, "", "", "", command.doc))
        for key, argument in command.arguments.items():
            type_ = argument.check.describe() + (", needed" if argument.needed else "")
            rows.append(("", "", f"`{key}`", type_, argument.check.unit, argument.doc))
    return table(("command", "taken by", "argument", "type", "unit", "meaning"), rows)


def limit_table() -> str:
    """The limits that bound what a message may cost its reader."""
    return table(
        ("what", "at most"),
        (
            ("message", f"{frames.MAX_MESSAGE} bytes"),
            ("text", f"{fields.MAX_TEXT} bytes"),
            ("msgpack array", f"{fields.MAX_LIST} entries"),
            ("msgpack map", f"{fields.MAX_MAP} entries"),
            ("msgpack extension types", "none"),
            ("dimensions of an array multiplied, those of 0 taken as 1", f"{fields.MAX_EXTENT} bytes"),
            ("nesting of `info`", f"{fields.MAX_DEPTH} levels"),
            ("messages held for a subscriber that does not read", publishing.SEND_QUEUE),
            ("a subscription", f"{publishing.MAX_SUBSCRIPTION} bytes"),
            ("different subscriptions at one time", publishing.MOST_PREFIXES),
            ("path of a socket", f"{runtime.MAX_SOCKET_PATH} bytes"),
        ),
    )


def link_tables() -> str:
    """One table per message of the board's link, with byte offsets in the body."""
    out = []
    for message in link.MESSAGES:
        crc = "plain CRC" if message.plain_crc else "seeded CRC"
        out.append(f"### {message.number:#04x} {message.wire_name} ({message.sender}, {crc})\n\n{message.__doc__}\n\n")
        rows: list[tuple[object, ...]] = [(0, "number", "u8", f"{message.number:#04x}")]
        offset: int | None = 1
        for name, kind, doc in message.layout():
            rows.append((offset if offset is not None else "then", f"`{name}`", kind, doc))
            fixed = kind in link_messages.STRUCT_CODES and offset is not None
            offset = offset + struct.calcsize("<" + link_messages.STRUCT_CODES[kind]) if fixed and offset else None
        out.append(table(("offset", "field", "type", "meaning"), rows) + "\n")
    return "".join(out)


def code_tables() -> str:
    """The enumerations used in messages of the link."""
    kinds: tuple[type[IntEnum] | type[Any], ...] = (link.Capability, link.NakReason, link.EventCode, link.SelfTestFault)
    out = []
    for kind in kinds:
        rows = ((member.value, f"`{member.name}`") for member in kind)
        out.append(f"### {kind.__name__}\n\n{kind.__doc__}\n\n{table(('value', 'name'), rows)}\n")
    return "".join(out)


def schema_block() -> str:
    """The schema text that the seed of the CRC is made from."""
    return f"```\n{link.SCHEMA_TEXT}```\n\nIts CRC-32, the schema hash: `0x{link.SCHEMA_HASH:08x}`.\n"


SECTIONS: dict[str, Callable[[], str]] = {
    "topics": topic_table,
    "header": lambda: field_table(frame_types.Frame),
    "reasons": reason_table,
    "frames": frame_tables,
    "limits": limit_table,
    "commands": command_table,
    "messages": link_tables,
    "codes": code_tables,
    "schema": schema_block,
}


def generate(text: str) -> str:
    """`text` with what is between its markers made anew. Raises KeyError for a marker that names no section."""
    marked = re.compile(r"(<!-- generated: (\w+) -->\n).*?(<!-- end -->)", re.DOTALL)
    return marked.sub(lambda m: f"{m[1]}\n{SECTIONS[m[2]]().rstrip()}\n\n{m[3]}", text)


def main(arguments: list[str]) -> int:
    """Write or check WIRE.md; the exit status."""
    have = WIRE_MD.read_text()
    want = generate(have)
    if arguments == ["--check"]:
        if have != want:
            print(f"{WIRE_MD} is not current: run python -m protocol.wire_doc", file=sys.stderr)
        return int(have != want)
    if arguments:
        print("usage: python -m protocol.wire_doc [--check]", file=sys.stderr)
        return 2
    WIRE_MD.write_text(want)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
