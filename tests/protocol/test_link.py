"""The board's link: round trips, and a decoder that nothing on the line can hurt."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from protocol import ad5940, link
from protocol.cobs import cobs_decode, cobs_encode


def full_frame(n=120, seq=0):
    z = (np.arange(n) + 1j).astype("c8")
    return link.ScanFrame(seq=seq, device_us=1, duration_us=45_000, config=1, z=z, status=np.arange(n) % 16)


@given(st.binary(max_size=2000) | st.lists(st.sampled_from([b"\0", b"\1", b"x" * 253, b"x" * 254])).map(b"".join))
def test_cobs_round_trip(data):
    stuffed = cobs_encode(data)
    assert 0 not in stuffed
    assert len(stuffed) <= len(data) + len(data) // 254 + 1
    assert cobs_decode(stuffed) == data


@given(st.binary(max_size=600))
def test_cobs_decode_refuses_or_decodes(data):
    try:
        cobs_decode(data)
    except ValueError:
        pass


def test_a_full_frame_is_as_long_as_the_rates_assume():
    assert 1040 < len(link.encode(full_frame())) < 1060


finite_or_not = st.floats(width=32)
messages = st.one_of(
    st.builds(link.Hello, schema_hash=st.integers(0, 2**32 - 1)),
    st.builds(link.Start, config=st.integers(0, 65535)),
    st.builds(link.Stop),
    st.builds(link.SelfTest),
    st.builds(link.Ack, of=st.integers(0, 255), value=st.integers(0, 2**32 - 1), device_us=st.integers(0, 2**64 - 1)),
    st.builds(link.TimeAsk, nonce=st.integers(0, 2**32 - 1)),
    st.builds(link.Time, nonce=st.integers(0, 2**32 - 1), device_us=st.integers(0, 2**64 - 1)),
    st.builds(link.Nak, of=st.integers(0, 255), reason=st.integers(0, 255), text=st.text(max_size=40)),
    st.builds(link.Event, code=st.integers(0, 65535), text=st.text(max_size=40)),
    st.builds(link.Ident, unique_id=st.binary(min_size=12, max_size=12), firmware=st.text(max_size=40)),
    st.builds(
        link.Config,
        config=st.integers(0, 65535),
        dft_points=st.integers(0, 65535),
        rtia_ohm=finite_or_not,
        scan=st.lists(st.lists(st.integers(0, 255), min_size=4, max_size=4), min_size=1, max_size=200).map(np.array),
    ),
    st.integers(1, link.MAX_SCAN).flatmap(
        lambda n: st.builds(
            link.ScanFrame,
            seq=st.integers(0, 2**32 - 1),
            device_us=st.integers(0, 2**64 - 1),
            duration_us=st.integers(0, 2**32 - 1),
            config=st.integers(0, 65535),
            z=st.binary(min_size=8 * n, max_size=8 * n).map(lambda b: np.frombuffer(b, "<c8")),
            status=st.binary(min_size=n, max_size=n).map(lambda b: np.frombuffer(b, "u1") & 15),
        )
    ),
)


def same(a, b):
    assert type(a) is type(b)
    for name, _, _ in a.layout():
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), strict=False)


@settings(deadline=None)
@given(st.lists(messages, max_size=5), st.integers(1, 50))
def test_messages_survive_the_line_in_any_pieces(sent, piece):
    line = b"".join(map(link.encode, sent))
    decoder, got = link.Decoder(), []
    for at in range(0, len(line), piece):
        got += decoder.feed(line[at : at + piece])
    assert (len(got), decoder.bad) == (len(sent), 0)
    for a, b in zip(sent, got, strict=True):
        same(a, b)


@settings(deadline=None)
@given(st.lists(st.binary(max_size=300) | st.sampled_from([b"\0", b"\xff" * 3000]), max_size=10))
def test_garbage_gives_nothing_and_a_frame_after_it_is_read(pieces):
    decoder = link.Decoder()
    for piece in pieces:
        assert decoder.feed(piece) == []
    decoder.feed(b"\0")
    same(decoder.feed(link.encode(full_frame()))[0], full_frame())


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 255))
def test_any_one_wrong_byte_costs_that_frame_only_and_is_counted(at, flip):
    line = bytearray(link.encode(full_frame(seq=1)))
    at = 1 + at % (len(line) - 2)
    line[at] ^= flip
    decoder = link.Decoder()
    got = decoder.feed(bytes(line) + link.encode(full_frame(seq=2)))
    assert [m.seq for m in got] == [2]
    assert decoder.bad >= 1 and decoder.last_error


def test_a_truncated_frame_costs_itself_only():
    line = link.encode(full_frame(seq=1))
    for cut in range(1, len(line) - 1, 7):
        decoder = link.Decoder()
        assert [m.seq for m in decoder.feed(line[:cut] + link.encode(full_frame(seq=2)))] == [2]


def raw_line(body, seed=link.SCHEMA_HASH):
    import zlib

    return b"\0" + cobs_encode(body + zlib.crc32(body, seed).to_bytes(4, "little")) + b"\0"


@pytest.mark.parametrize(
    ("line", "what"),
    [
        (b"\0\5ab\0", "bad_cobs"),
        (b"\0\2a\0", "bad_crc"),
        (raw_line(b"\x84" + bytes(20), seed=1), "bad_crc"),
        (raw_line(b"\x7e123"), "unknown"),
        (raw_line(b"\x03"), "bad_payload"),
        (raw_line(b"\x03\1\0\0"), "bad_payload"),
        (raw_line(b"\x84" + bytes(18) + b"\0\0"), "bad_payload"),
        (raw_line(b"\x84" + bytes(18) + b"\2\0" + bytes(9)), "bad_payload"),
        (raw_line(b"\x02" + bytes(8) + b"\2\0" + bytes(4)), "bad_payload"),
        (b"\0" + b"\xff" * 20_000 + b"\0", "oversize"),
    ],
)
def test_each_kind_of_damage_is_counted_under_its_name(line, what):
    for step in (1, 1000, len(line)):
        decoder = link.Decoder()
        for at in range(0, len(line), step):
            assert decoder.feed(line[at : at + step]) == []
        assert dict(decoder.counts) == {what: 1}
        assert decoder.last_error.startswith(what)


def test_an_endless_line_without_delimiter_takes_no_memory():
    decoder = link.Decoder()
    for _ in range(100):
        decoder.feed(b"\xff" * 10_000)
    assert len(decoder._rest) < 2 * link.MAX_BODY and decoder.counts["oversize"] == 1


def test_another_schema_is_known_by_name_once_its_ident_has_come():
    other = link.SCHEMA_HASH ^ 1
    decoder = link.Decoder()
    assert decoder.feed(link.encode(full_frame(), other)) == []
    (ident,) = decoder.feed(link.encode(link.Ident(schema_hash=other), other))
    assert ident.schema_hash == other
    assert decoder.feed(link.encode(full_frame(), other)) == []
    assert dict(decoder.counts) == {"bad_crc": 1, "good": 1, "other_schema": 1}
    assert f"{other:08x}" in decoder.last_error and f"{link.SCHEMA_HASH:08x}" in decoder.last_error


@pytest.mark.parametrize(
    "message",
    [
        link.Start(config=65536),
        link.Start(config=None),
        link.Config(config=1, dft_points=256, rtia_ohm=1e3, scan=np.zeros((3, 3))),
        link.Config(config=1, dft_points=256, rtia_ohm=1e3, scan=np.full((1, 4), 256)),
        link.Config(config=1, dft_points=256, rtia_ohm=1e3, scan=np.zeros((0, 4))),
        link.ScanFrame(seq=0, device_us=0, duration_us=0, config=0, z=np.zeros(3), status=np.zeros(2)),
        link.ScanFrame(seq=0, device_us=0, duration_us=0, config=0, z=np.zeros(600), status=np.zeros(600, "u1")),
    ],
    ids=lambda m: type(m).__name__,
)
def test_what_does_not_fit_its_message_is_not_sent(message):
    with pytest.raises(link.LinkError, match=message.wire_name):
        link.encode(message)


def test_a_long_text_is_cut_and_a_cut_character_is_no_error():
    (event,) = link.Decoder().feed(link.encode(link.Event(code=1, text="x" + "ä" * 300)))
    assert event.text.startswith("xää") and len(event.text.encode()) <= link.MAX_TEXT + 2


def test_fifo_words_by_hand():
    """ECC 0, sequence 2, channel 31, data -1 and the extremes of 18-bit two's complement."""
    assert ad5940.encode_fifo(np.array([-1]), seq=2)[0] == 0b0000000_10_11111_111111111111111111
    assert list(ad5940.encode_fifo(np.array([131071, -131072, 131072, -200000]), channel=0)) == [
        0x1FFFF, 0x20000, 0x1FFFF, 0x20000,
    ]  # fmt: skip
    data, seq, channel = ad5940.decode_fifo(np.array([0xFFFFFFFF, 0x00020000, 0x0001FFFF], "u4"))
    assert list(data) == [-1, -131072, 131071]
    assert (seq[0], channel[0]) == (3, 31)


@given(st.integers(-131072, 131071), st.integers(0, 3), st.integers(0, 31), st.integers(0, 127))
def test_fifo_words_round_trip(data, seq, channel, ecc):
    words = ad5940.encode_fifo(np.array([data]), seq, channel, ecc)
    assert [int(x[0]) for x in ad5940.decode_fifo(words)] == [data, seq, channel]


def test_impedance_of_a_resistor_and_a_capacitor():
    """A current of 2 with RTIA 1000 and voltages of 3, 3j: 1500 ohm, and the imaginary sign as the chip inverts it."""
    current = ad5940.dft_pair(np.array([2000.0 + 0j, 2000.0, 0.0]))
    voltage = ad5940.dft_pair(np.array([3000.0 + 0j, -3000.0j, 1.0]))
    assert list(voltage[1]) == [0, 3000]
    z = ad5940.impedance(voltage, current, 1000.0)
    np.testing.assert_allclose(z[:2], [1500.0, -1500.0j])
    assert not np.isfinite(z[2])
