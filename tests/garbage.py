"""Bytes that no client should send: at random, and real messages with bytes or numbers changed."""

from __future__ import annotations

import random
import re
from collections.abc import Iterator, Sequence

ABSURD = (b"0", b"-1", b"nan", b"inf", b"-inf", b"1e308", b"9" * 40, b"2147483648", b"1E99", b"", b"0x7f", b"\xff")


def garbage(real: Sequence[bytes], count: int, *, seed: int = 1, most_bytes: int = 300) -> Iterator[bytes]:
    """`count` byte strings of at most `most_bytes` or the length of a real message; the same for the same seed."""
    source = random.Random(seed)
    kinds = (_noise, _bitten, _renumbered, _cut)
    for number in range(count):
        yield kinds[number % len(kinds)](source, source.choice(real), most_bytes)


def _noise(source: random.Random, real: bytes, most_bytes: int) -> bytes:
    return source.randbytes(source.randint(1, most_bytes))


def _bitten(source: random.Random, real: bytes, most_bytes: int) -> bytes:
    """A real message with some bytes changed."""
    changed = bytearray(real)
    for _ in range(source.randint(1, 4)):
        changed[source.randrange(len(changed))] = source.randrange(256)
    return bytes(changed)


def _renumbered(source: random.Random, real: bytes, most_bytes: int) -> bytes:
    """A real message whose numbers are absurd, one or all."""
    share = source.choice((0.2, 1.0))
    return re.sub(rb"-?\d+(\.\d+)?", lambda m: source.choice(ABSURD) if source.random() < share else m[0], real)


def _cut(source: random.Random, real: bytes, most_bytes: int) -> bytes:
    """The beginning of a real message and the end of it, or of nothing."""
    return real[: source.randrange(len(real))] + real[source.randrange(len(real)) :] * source.randint(0, 2)
