"""Makes protocol/vectors/*/*.bin from the JSON beside each as WIRE.md says, without the package's code."""

import json
import struct
import zlib
from pathlib import Path

import msgpack

PROTOCOL = Path(__file__).parents[2] / "protocol"
VECTORS = PROTOCOL / "vectors"
ITEM = {"<f4": "f", "<f8": "d", "<c8": "ff", "|u1": "B"}

# number and fixed fields of each message of the link, from WIRE.md's tables
LINK = {
    "Hello": (0x01, "<BI", "link_version schema_hash"),
    "Config": (0x02, "<HHfBIBBH", "config dft_points rtia_ohm parts frequency_hz sinc3 window settle_us"),
    "Start": (0x03, "<H", "config"),
    "Stop": (0x04, "<", ""),
    "SelfTest": (0x05, "<", ""),
    "TimeAsk": (0x06, "<I", "nonce"),
    "Ident": (0x81, "<BIH12sIBH", "link_version schema_hash chip_id unique_id capabilities electrodes max_scan"),
    "Ack": (0x82, "<BIQ", "of value device_us"),
    "Nak": (0x83, "<BB", "of reason"),
    "Frame": (0x84, "<IQIHBB", "seq device_us duration_us config part parts"),
    "Event": (0x85, "<H", "code"),
    "Time": (0x86, "<IQ", "nonce device_us"),
}
PLAIN_CRC = ("Hello", "Ident", "Nak")


def number(value):
    return float(value) if isinstance(value, str) else value  # "nan", "inf", "-inf"


def on_wire(value):
    """JSON's arrays {dtype, shape, values} as the wire's {dtype, shape, data}; everything else as it is."""
    if isinstance(value, dict) and value.keys() == {"dtype", "shape", "values"}:
        form = "<" + ITEM[value["dtype"]]
        rows = (v if isinstance(v, list) else [v] for v in value["values"])
        data = b"".join(struct.pack(form, *map(number, row)) for row in rows)
        return {"dtype": value["dtype"], "shape": value["shape"], "data": data}
    if isinstance(value, dict):
        return {k: on_wire(v) for k, v in value.items()}
    return [on_wire(v) for v in value] if isinstance(value, list) else value


def frame_bytes(vector):
    return f"{vector['topic']}/{vector['skin']}".encode() + b"\0" + msgpack.packb(on_wire(vector["fields"]))


def stuff(data):
    """COBS, byte by byte."""
    out, block = bytearray(), bytearray()
    for i, byte in enumerate(data):
        if byte:
            block.append(byte)
        if not byte or (len(block) == 254 and i + 1 < len(data)):
            out += bytes([len(block) + 1]) + block
            block.clear()
    return bytes(out + bytes([len(block) + 1]) + block)


def schema_hash():
    text = (PROTOCOL / "WIRE.md").read_text().split("<!-- generated: schema -->")[1].split("```")[1]
    return zlib.crc32(text.lstrip("\n").encode())


def link_bytes(vector):
    name, fields = vector["message"], vector["fields"]
    code, form, heads = LINK[name]
    given = (bytes.fromhex(v) if isinstance(v, str) else v for v in map(fields.get, heads.split()))
    body = bytes([code]) + struct.pack(form, *given)
    if name == "Config":
        body += struct.pack("<H", len(fields["scan"])) + bytes(e for row in fields["scan"] for e in row)
    if name == "Frame":
        body += struct.pack("<H", len(fields["z"]))
        body += b"".join(struct.pack("<ff", *map(number, z)) for z in fields["z"])
        status = fields["status"] + [0] * (len(fields["status"]) % 2)
        body += bytes(low + 16 * high for low, high in zip(status[::2], status[1::2], strict=True))
    body += fields.get("text", fields.get("firmware", "")).encode()
    crc = zlib.crc32(body, 0 if name in PLAIN_CRC else schema_hash())
    return b"\0" + stuff(body + struct.pack("<I", crc)) + b"\0"


if __name__ == "__main__":
    for folder, encode in (("frames", frame_bytes), ("link", link_bytes)):
        for path in sorted((VECTORS / folder).glob("*.json")):
            path.with_suffix(".bin").write_bytes(encode(json.loads(path.read_text())))
