"""Two 12-bit pixels in three bytes, both ways."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as arrays

from coupole.storage.packing import Order, pack12, unpack12

ORDERS: tuple[Order, ...] = ("lsb", "msb")
Pixels = np.ndarray[Any, np.dtype[np.uint16]]


def twelve_bits(most: int = 64) -> st.SearchStrategy[Pixels]:
    """An even number of pixels below 4096."""
    return st.integers(0, most).flatmap(
        lambda pairs: arrays.arrays(np.uint16, 2 * pairs, elements=st.integers(0, 4095))
    )


def test_the_least_significant_bits_come_first_in_lsb() -> None:
    assert pack12(np.array([0x321, 0x654], np.uint16), "lsb").tobytes() == bytes([0x21, 0x43, 0x65])


def test_the_most_significant_bits_come_first_in_msb() -> None:
    assert pack12(np.array([0x123, 0x456], np.uint16), "msb").tobytes() == bytes([0x12, 0x34, 0x56])


@pytest.mark.parametrize("order", ORDERS)
@given(pixels=twelve_bits())
def test_unpacked_pixels_are_those_that_were_packed(order: Order, pixels: Pixels) -> None:
    assert np.array_equal(unpack12(pack12(pixels, order), order), pixels)


@given(pixels=twelve_bits())
def test_msb_bytes_are_the_pixels_bits_one_after_the_other(pixels: Pixels) -> None:
    bits = "".join(f"{pixel:012b}" for pixel in pixels.tolist())
    assert pack12(pixels, "msb").tobytes() == int(bits or "0", 2).to_bytes(len(bits) // 8, "big")


@given(pixels=twelve_bits())
def test_lsb_bytes_are_one_little_endian_number_of_twelve_bit_digits(pixels: Pixels) -> None:
    number = sum(pixel << 12 * place for place, pixel in enumerate(pixels.tolist()))
    assert pack12(pixels, "lsb").tobytes() == number.to_bytes(len(pixels) // 2 * 3, "little")


@pytest.mark.parametrize("order", ORDERS)
def test_a_frame_is_packed_row_by_row(order: Order) -> None:
    frame = np.arange(48, dtype=np.uint16).reshape(4, 12) * 85
    assert np.array_equal(pack12(frame, order), pack12(frame.reshape(-1), order))
    assert np.array_equal(pack12(np.asfortranarray(frame), order), pack12(frame, order))


def test_an_odd_number_of_pixels_is_refused() -> None:
    with pytest.raises(ValueError, match="even number of pixels, found 3"):
        pack12(np.zeros(3, np.uint16))


def test_a_pixel_of_more_than_twelve_bits_is_refused() -> None:
    with pytest.raises(ValueError, match="12 bits, found a bit above them in 4096"):
        pack12(np.array([1, 4096], np.uint16))


def test_bytes_that_three_does_not_divide_are_refused() -> None:
    with pytest.raises(ValueError, match="multiple of 3 bytes, found 4"):
        unpack12(np.zeros(4, np.uint8))
