"""The Xsens wire format against recorded frames, documented vectors and damaged streams."""

from __future__ import annotations

import struct
import tomllib
from fractions import Fraction
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from drivers import mtdata2, xbus
from drivers.errors import CorruptFrame
from drivers.mtdata2 import Data, Sample, SampleDecoder, decode_data
from drivers.xbus import Message, Output, XbusParser

RECORDED = tomllib.loads((Path(__file__).parent / "data" / "xbus.toml").read_text())


def recorded(source: str, name: str) -> bytes:
    entry = RECORDED[source][name]
    return bytes.fromhex(entry["frame"])


def data_of(frame: bytes) -> bytes:
    ((message, data),) = XbusParser().feed(frame)
    assert message == Message.MTDATA2
    return data


def measurement(counter: int = 5, orientation: bool = True, acceleration: tuple[float, ...] = (0.0, 0.0, 9.8)) -> bytes:
    data = struct.pack(">HBHHBI", Data.PACKET_COUNTER, 2, counter, Data.SAMPLE_TIME_FINE, 4, 25 * counter)
    if orientation:
        data += struct.pack(">HB4f", Data.QUATERNION, 16, 1.0, 0.0, 0.0, 0.0)
    data += struct.pack(">HB3f", Data.ACCELERATION, 12, *acceleration)
    data += struct.pack(">HB3f", Data.RATE_OF_TURN, 12, 0.1, 0.2, 0.3)
    data += struct.pack(">HBI", Data.STATUS_WORD, 4, 3)
    return xbus.encode(Message.MTDATA2, data)


@pytest.mark.parametrize(("source", "name"), [(s, n) for s, entries in RECORDED.items() for n in entries])
def test_recorded_frames_decode_to_their_documented_values(source, name):
    entry, items = RECORDED[source][name], decode_data(data_of(recorded(source, name)))
    fields = {
        "counter": Data.PACKET_COUNTER,
        "time": Data.SAMPLE_TIME_FINE,
        "acceleration": Data.ACCELERATION,
        "rate": Data.RATE_OF_TURN,
        "quaternion": Data.QUATERNION,
        "status": Data.STATUS_WORD,
    }
    for field, identifier in fields.items():
        if field in entry:
            wanted = entry[field] if isinstance(entry[field], list) else [entry[field]]
            assert items[identifier] == pytest.approx(wanted, rel=1e-5, abs=1e-5)


@pytest.mark.parametrize("name", ["fixed12_20", "fixed16_32", "float64"])
def test_recorded_fixed_point_and_double_are_one_device_lying_still(name):
    items = decode_data(data_of(recorded("einride", name)))
    gravity = sum(value**2 for value in items[Data.ACCELERATION]) ** 0.5
    assert gravity == pytest.approx(9.81, abs=0.03)
    assert max(abs(value) for value in items[Data.RATE_OF_TURN]) < 0.02
    assert items[Data.DELTA_QUATERNION][0] == pytest.approx(1.0, abs=1e-5)


@given(st.lists(st.fractions(-2000, 2000), min_size=3, max_size=3))
def test_fixed_point_formats_are_exact(values):
    for form, bits, pack in ((1, 20, None), (2, 32, ">Ih")):
        steps = [round(value * 2**bits) for value in values]
        if pack is None:
            payload = b"".join(step.to_bytes(4, "big", signed=True) for step in steps)
        else:
            payload = b"".join(struct.pack(pack, step & 0xFFFFFFFF, step >> 32) for step in steps)
        data = struct.pack(">HB", Data.ACCELERATION | form, len(payload)) + payload
        decoded = decode_data(data)[Data.ACCELERATION]
        assert [Fraction(value) for value in decoded] == [Fraction(step, 2**bits) for step in steps]


@pytest.mark.parametrize(
    ("message", "data", "expected"),
    [
        (Message.GO_TO_CONFIG, "", "faff3000d1"),
        (Message.GO_TO_MEASUREMENT, "", "faff1000f1"),
        (Message.REQUEST_DEVICE_ID, "", "faff000001"),
        (Message.REQUEST_PRODUCT_CODE, "", "faff1c00e5"),
        (Message.REQUEST_FIRMWARE, "", "faff1200ef"),
        (Message.RESET, "", "faff4000c1"),
        (Message.WAKE_UP_ACK, "", "faff3f00c2"),
        (Message.SET_NO_ROTATION, "0006", "faff22020006d7"),
        (Message.RESET_ORIENTATION, "0001", "faffa40200015a"),
        (Message.SET_BAUD, "0a", "faff18010ade"),
        (Message.ERROR, "03", "faff420103bb"),
    ],
)
def test_documented_messages(message, data, expected):
    assert xbus.encode(message, bytes.fromhex(data)).hex() == expected
    assert XbusParser().feed(bytes.fromhex(expected)) == [(message, bytes.fromhex(data))]


def test_documented_output_configuration():
    outputs = [Output(0x1020, 0xFFFF), Output(0x1060, 0xFFFF), Output(0xE020, 0xFFFF)]
    outputs += [Output(0x2010, 400), Output(0x4020, 400), Output(0x8020, 400)]
    frame = xbus.encode(Message.SET_OUTPUT_CONFIGURATION, xbus.encode_outputs(outputs))
    assert frame.hex() == "faffc0181020ffff1060ffffe020ffff201001904020019080200190ac"
    acknowledged = XbusParser().feed(bytes.fromhex("FAFFC1081020FFFF1060FFFF9C"))[0][1]
    assert xbus.decode_outputs(acknowledged) == outputs[:2]
    with pytest.raises(CorruptFrame, match="multiple"):
        xbus.decode_outputs(b"\x10\x20\xff")


def test_long_messages_have_a_two_byte_length():
    data = bytes(range(250)) * 2
    assert XbusParser().feed(xbus.encode(Message.CONFIGURATION, data)) == [(Message.CONFIGURATION, data)]


@pytest.mark.parametrize("orientation", [True, False])
def test_the_compiled_layout_reads_what_the_walk_reads(orientation):
    fresh, warm = SampleDecoder(), SampleDecoder()
    warm.decode(data_of(measurement(1, orientation)))
    for counter in range(2, 20):
        data = data_of(measurement(counter, orientation, (0.5 * counter, -1.0, 9.0)))
        assert warm.decode(data) == SampleDecoder().decode(data)
        assert warm.decode(data).counter == counter
    assert bool(fresh.decode(data_of(measurement(3, orientation))).orientation) is orientation


def test_the_decoder_follows_a_changed_configuration():
    decoder = SampleDecoder()
    for orientation in (True, False, True):
        assert bool(decoder.decode(data_of(measurement(7, orientation))).orientation) is orientation


def test_a_message_without_what_the_driver_needs_is_named():
    items = struct.pack(">HBH", Data.PACKET_COUNTER, 2, 1)
    with pytest.raises(CorruptFrame, match="0x1060"):
        SampleDecoder().decode(items)


@given(st.lists(st.integers(1, 40), min_size=1, max_size=40), st.integers(1, 6))
def test_any_split_of_the_stream_gives_the_same_packets(cuts, count):
    frames = [measurement(counter) for counter in range(count)]
    stream, parser, packets = b"".join(frames), XbusParser(), []
    position = 0
    for cut in [*cuts, len(stream)]:
        packets += parser.feed(stream[position : position + cut])
        position += cut
    packets += parser.feed(stream[position:])
    assert packets == [(Message.MTDATA2, data_of(frame)) for frame in frames]
    assert (parser.skipped, parser.corrupt) == (0, 0)


@given(st.binary(max_size=120), st.lists(st.integers(1, 50), max_size=5))
@settings(max_examples=300)
def test_garbage_is_skipped_and_the_next_good_frame_is_found(garbage, cuts):
    good = measurement(9)
    parser, packets, position = XbusParser(), [], 0
    stream = garbage + good
    for cut in [*cuts, len(stream)]:
        packets += parser.feed(stream[position : position + cut])
        position += cut
    packets += parser.feed(stream[position:])
    assert (Message.MTDATA2, data_of(good)) in packets


@given(st.data())
@settings(max_examples=300)
def test_one_damaged_frame_costs_no_other(data):
    frames = [measurement(counter) for counter in range(4)]
    damaged = bytearray(frames[1])
    place = data.draw(st.integers(0, len(damaged) - 1))
    damaged[place] ^= data.draw(st.integers(1, 255))
    parser = XbusParser()
    packets = []
    for chunk in (frames[0], bytes(damaged), frames[2], frames[3]):
        packets += parser.feed(chunk)
    for good in (frames[0], frames[2], frames[3]):
        assert (Message.MTDATA2, data_of(good)) in packets
    assert parser.skipped + parser.corrupt > 0


@given(st.lists(st.binary(max_size=64), max_size=30))
@settings(max_examples=200)
def test_nothing_is_kept_for_ever(chunks):
    parser = XbusParser()
    for chunk in chunks:
        parser.feed(chunk)
    assert len(parser._rest) <= xbus.MAX_DATA + 8


@given(st.binary(max_size=80))
@settings(max_examples=300)
def test_any_data_decodes_or_is_called_corrupt(data):
    for decode, kind in ((decode_data, dict), (SampleDecoder().decode, Sample)):
        try:
            found = decode(data)
        except CorruptFrame:
            continue
        assert isinstance(found, kind)


def test_status_bits_of_the_recorded_shake():
    status = RECORDED["scottapotamas"]["clipping"]["status"]
    assert status & mtdata2.STATUS_SELF_TEST
    assert not status & mtdata2.STATUS_ORIENTATION_VALID
    assert status & mtdata2.STATUS_CLIPPING
    assert status & mtdata2.STATUS_CLIP_ACCELERATION == 1 << 10  # z
    assert status & mtdata2.STATUS_CLIP_RATE == 1 << 12  # y
