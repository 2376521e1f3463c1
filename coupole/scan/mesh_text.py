"""Numbers in text files of gigabytes: lines, tokens and decimal numbers of a byte array, in compiled code.

The numbers are read twice: first to count them, then to fill arrays of the right size.
"""

from __future__ import annotations

import numpy as np

from coupole.kernels import kernel

OK, NOT_A_NUMBER, TOO_FEW, BAD_CORNER = 0, 1, 2, 3
_NEWLINE, _SPACE, _TAB, _RETURN = 10, 32, 9, 13
_DIGITS = 18
"""Greatest number of digits: more do not fit into a 64-bit integer, and further digits are below the resolution of
float64."""


@kernel
def line_end(data, at):  # type: ignore[no-untyped-def]
    """Return the offset of the newline that ends the line at `at`, or the end of the data."""
    while at < len(data) and data[at] != _NEWLINE:
        at += 1
    return at


@kernel
def skip_blanks(data, at, end):  # type: ignore[no-untyped-def]
    while at < end and (data[at] == _SPACE or data[at] == _TAB or data[at] == _RETURN):
        at += 1
    return at


@kernel
def token_end(data, at, end):  # type: ignore[no-untyped-def]
    while at < end and data[at] != _SPACE and data[at] != _TAB and data[at] != _RETURN:
        at += 1
    return at


@kernel
def whole(data, at, end):  # type: ignore[no-untyped-def]
    """Return the integer at `at`, the offset after it, and True if there was one."""
    negative = at < end and data[at] == 45
    if at < end and (data[at] == 45 or data[at] == 43):
        at += 1
    value, first = np.int64(0), at
    while at < end and 48 <= data[at] <= 57 and at - first < _DIGITS:
        value = value * 10 + np.int64(data[at] - 48)
        at += 1
    return (-value if negative else value), at, at > first


@kernel
def decimal(data, at, end):  # type: ignore[no-untyped-def]
    """Return the decimal number at `at` (also nan and inf, as NaN), the offset after it, and True if there was
    one."""
    stop = token_end(data, at, end)
    negative = at < stop and data[at] == 45
    if at < stop and (data[at] == 45 or data[at] == 43):
        at += 1
    if at < stop and (data[at] | 32) in (110, 105):  # the n of nan, or the i of inf
        return np.nan, stop, True
    mantissa, digits, exponent, any_digit, after_point = np.int64(0), 0, 0, False, False
    while at < stop:
        c = data[at]
        if 48 <= c <= 57:
            any_digit = True
            if digits < _DIGITS:
                mantissa = mantissa * 10 + np.int64(c - 48)
                digits += 1 if mantissa else 0
                exponent -= 1 if after_point else 0
            else:
                exponent += 0 if after_point else 1
        elif c == 46 and not after_point:
            after_point = True
        else:
            break
        at += 1
    if at < stop and (data[at] | 32) == 101:
        power, at, has_power = whole(data, at + 1, stop)
        any_digit = any_digit and has_power
        exponent += power
    value = np.float64(mantissa) * 10.0**exponent if exponent >= 0 else np.float64(mantissa) / 10.0**-exponent
    return (-value if negative else value), at, any_digit and at == stop
