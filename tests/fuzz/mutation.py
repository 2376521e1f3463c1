"""Mutations of real files: bytes, numbers, lines and words, all from one random generator."""

from __future__ import annotations

import re
from random import Random

NUMBERS = (
    b"0", b"-0", b"-1", b"1", b"255", b"256", b"65535", b"65536", b"2147483648", b"4294967295", b"4294967296",
    b"18446744073709551616", b"1e8", b"-1e8", b"1e30", b"1e308", b"1e309", b"-1e309", b"1e-308", b"nan", b"inf",
    b"-inf", b".5", b"5.", b"0x10", b"9" * 400, b"1" + b"0" * 60, b"''",
)  # fmt: skip
WORDS = (
    b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\t", b"\r", b"\r\n", b"\n\n", b"{}", b"[]", b"null", b"~", b"true",
    b"...", b"---", b"&a [*a]", b"<<: *a", b"!!python/object:x", b"'\\0'", b'"\\0"', b"\"\\ud800\"",
    b"../../../../etc/passwd",
    b"/dev/zero", b"~nobody-at-all/x", b"x" * 5000, b"%s%n{0}", b",,,,", b"#",
)  # fmt: skip
HOSTILE = (
    b"9" * 5000, b"-" + b"9" * 50, b"1." + b"9" * 5000, b"1e" + b"9" * 5000, b"NaN", b"-Infinity", b"1e999",
    b"[" * 10_000, b"[" * 10_000 + b"]" * 10_000, b'{"a":' * 3000 + b"1" + b"}" * 3000, b"[" * 120 + b"]" * 120,
    b"[&a [1, 1], &b [*a, *a, *a, *a], " + b", ".join(
        b"&%c [%s]" % (name, b", ".join([b"*%c" % (name - 1)] * 9)) for name in range(ord("c"), ord("z"))
    ) + b"]", b"&x [*x]", b"\xff\xfe", b"\xef\xbb\xbf1", b"\"\\ud800\"",
)  # fmt: skip
"""Values that readers of JSON and YAML may end in a traceback of their own for, or in endless work."""
_NUMBER = re.compile(rb"[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def mutated(seed: bytes, random: Random) -> bytes:
    """The seed with one to eight changes."""
    data = seed
    for _ in range(random.choice((1, 1, 1, 2, 3, 8))):
        data = random.choice(_CHANGES)(data, random)
    return data


def with_hostile(seed: bytes, random: Random, number: int) -> bytes:
    """The seed with one of HOSTILE in the place of one of its numbers; they come by turns."""
    found = list(_NUMBER.finditer(seed[:100_000]))
    first, last = random.choice(found).span() if found else (len(seed), len(seed))
    return seed[:first] + HOSTILE[number % len(HOSTILE)] + seed[last:]


def _flip(data: bytes, random: Random) -> bytes:
    changed = bytearray(data)
    for _ in range(random.choice((1, 1, 4, 32))):
        if changed:
            changed[random.randrange(len(changed))] ^= 1 << random.randrange(8)
    return bytes(changed)


def _cut(data: bytes, random: Random) -> bytes:
    return data[: random.randrange(len(data) + 1)]


def _leave_out(data: bytes, random: Random) -> bytes:
    first = random.randrange(len(data) + 1)
    return data[:first] + data[first + random.randrange(1, 64) :]


def _repeat(data: bytes, random: Random) -> bytes:
    first = random.randrange(len(data) + 1)
    last = first + random.randrange(1, 64)
    return data[:last] + data[first:last] * random.choice((1, 2, 50)) + data[last:]


def _overwrite(data: bytes, random: Random) -> bytes:
    first, count = random.randrange(len(data) + 1), random.choice((1, 2, 4, 8))
    return (
        data[:first]
        + random.choice((b"\0", b"\xff", b"\x7f", random.randbytes(1))) * count
        + data[first + count :]
    )


def _put_in(data: bytes, random: Random) -> bytes:
    at = random.randrange(len(data) + 1)
    return data[:at] + random.choice(WORDS) + data[at:]


def _other_number(data: bytes, random: Random) -> bytes:
    found = list(_NUMBER.finditer(data[:100_000]))
    if not found:
        return _overwrite(data, random)
    first, last = random.choice(found).span()
    return data[:first] + random.choice(NUMBERS) + data[last:]


def _lines(data: bytes, random: Random) -> bytes:
    lines = data.split(b"\n")
    at, other = random.randrange(len(lines)), random.randrange(len(lines))
    match random.randrange(4):
        case 0:
            del lines[at]
        case 1:
            lines[at], lines[other] = lines[other], lines[at]
        case 2:
            lines.insert(other, lines[at])
        case _:
            lines[at] = b"  " + lines[at]
    return b"\n".join(lines)


_CHANGES = (
    _flip, _cut, _leave_out, _repeat, _overwrite, _put_in, _other_number, _other_number, _other_number, _lines,
    _lines,
)  # fmt: skip
