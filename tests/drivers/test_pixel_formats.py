"""Packed pixels of GenICam cameras come out bit by bit as they went in."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.typing import NDArray

from drivers.camera.pixel_formats import FORMATS, pixels_in_a_group, widen
from sim.devices import gige_pixels

COUNT = 40


def bits_of(pixels: NDArray[np.uint16], depth: int) -> NDArray[np.uint8]:
    """[pixels, depth] bits, the least first."""
    return (pixels[:, None] >> np.arange(depth)[None] & 1).astype(np.uint8)


def wire(pixels: NDArray[np.uint16], name: str) -> NDArray[np.uint8]:
    """What the format's definition makes of `pixels`, written down bit by bit."""
    depth = FORMATS[name].bit_depth
    if name.endswith("p"):  # PFNC: one stream of bits, the least first
        return np.packbits(bits_of(pixels, depth).reshape(-1), bitorder="little")
    if name.endswith("Packed"):  # GigE Vision 1: upper eight bits in bytes of their own, the rest shares one
        low = depth - 8
        first, second = pixels[0::2], pixels[1::2]
        middle = (first & (1 << low) - 1) | (second & (1 << low) - 1) << 4
        return np.stack([first >> low, middle, second >> low], axis=1).astype(np.uint8).reshape(-1)
    return pixels.astype(np.uint8)


WIDENED = [name for name, known in FORMATS.items() if known.packing != "two bytes"]


@pytest.mark.parametrize("name", WIDENED)
@given(data=st.data())
def test_pixels_are_widened_exactly(name: str, data: st.DataObject) -> None:
    known = FORMATS[name]
    values = st.integers(0, (1 << known.bit_depth) - 1)
    pixels = data.draw(arrays(np.uint16, COUNT, elements=values))
    packed = wire(pixels, name)
    assert len(packed) == known.wire_bytes(COUNT)
    out = np.full(COUNT, 0xFFFF, np.uint16)
    widen(out, packed, known)
    assert out.tolist() == pixels.tolist()


@pytest.mark.parametrize("code", gige_pixels.LAYOUTS)
@given(frame=arrays(np.uint16, (4, 12), elements=st.integers(0, 4095)))
def test_the_stand_in_sends_what_the_driver_reads(code: int, frame: NDArray[np.uint16]) -> None:
    (known,) = (known for known in FORMATS.values() if known.code == code)
    data = np.zeros(known.wire_bytes(frame.size), np.uint8)
    gige_pixels.encode(data, frame, code, 12)
    out = np.zeros(frame.size, np.uint16)
    if known.packing == "two bytes":
        out[:] = data.view("<u2")
    else:
        widen(out, data, known)
    shift = known.bit_depth - 12
    expected = frame.astype(np.int64) << shift if shift > 0 else frame >> -shift
    assert out.reshape(frame.shape).tolist() == expected.tolist()


def test_each_format_has_the_bits_that_its_code_says() -> None:
    bits = {"two bytes": 16, "one byte": 8, "10p": 10, "12p": 12, "10Packed": 12, "12Packed": 12}
    assert all(known.wire_bits == bits[known.packing] for known in FORMATS.values())
    assert len({known.code for known in FORMATS.values()}) == len(FORMATS)


def test_pixels_that_share_bytes_are_counted_in_whole_groups() -> None:
    assert all(
        known.wire_bytes(pixels_in_a_group(known)) * 8 == pixels_in_a_group(known) * known.wire_bits
        for known in FORMATS.values()
    )
