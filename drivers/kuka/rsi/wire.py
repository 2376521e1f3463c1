"""Reads the packets of KUKA's RSI controller, and forms the answers.

The names of elements are set in the controller's RSI configuration, so they are parameters here.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import NamedTuple


class Packet(NamedTuple):
    ipoc: bytes
    """IPOC as received, to be sent back unchanged."""
    joints_deg: tuple[float, ...]
    delay: int | None
    """The counter of late answers; None where the controller does not send it."""


_LARGEST_DELAY, _LARGEST_IPOC = 2**31 - 1, 2**63 - 1
"""Largest numbers of the controller's types. A larger number cannot come from a controller."""
_LARGEST_DEG = 1e4
"""Largest angle: no axis turns 27 times."""


_ATTRIBUTE = re.compile(rb"""([A-Za-z_]\w*)\s*=\s*["']\s*([^"']*?)\s*["']""")
_TYPE = re.compile(rb"""<Rob\b[^>]*?\bTYPE\s*=\s*["']([^"']*)["']""", re.IGNORECASE)


def packet_parser(measured_tag: str, delay_tag: str) -> Callable[[bytes], Packet | None]:
    """Return a parser of the controller's packets. Elements and attributes may have any order; unknown ones are
    ignored.

    It returns None if IPOC or an axis is missing, or if one of them, or the delay counter, is not a possible
    number.
    """
    axes_tag, delay = re.escape(measured_tag).encode(), re.escape(delay_tag).encode()
    usual_axes = re.compile(
        rb"<%s " % axes_tag + rb" ".join(rb'A%d="([^"]+)"' % axis for axis in range(1, 7)) + rb"\s*/>"
    )
    any_axes = re.compile(rb"<%s\b([^>]*)>" % axes_tag)
    usual_tail = re.compile(rb'<%s D="(\d+)"\s*/>\s*<IPOC>(\d+)</IPOC>' % delay)
    any_delay = re.compile(rb"""<%s\b(?:[^>]*?\bD\s*=\s*["']\s*(\d+)\s*["'])?""" % delay)
    any_ipoc = re.compile(rb"<IPOC>\s*(\d+)\s*</IPOC>")
    names = [b"A%d" % axis for axis in range(1, 7)]

    def parse(packet: bytes) -> Packet | None:
        try:
            if match := usual_axes.search(packet):
                joints_deg = tuple(map(float, match.groups()))
            elif match := any_axes.search(packet):
                attributes = dict(_ATTRIBUTE.findall(match[1]))
                joints_deg = tuple(float(attributes[name]) for name in names)
            else:
                return None
        except (KeyError, ValueError):
            return None
        if not all(abs(angle) <= _LARGEST_DEG for angle in joints_deg):  # this is also false for a NaN
            return None
        if match := usual_tail.search(packet):
            late, ipoc = match[1], match[2]
        else:
            ipoc_match = any_ipoc.search(packet)
            delay_match = any_delay.search(packet)
            if ipoc_match is None or (delay_match and delay_match[1] is None):
                return None
            late, ipoc = delay_match[1] if delay_match else None, ipoc_match[1]
        if int(ipoc) > _LARGEST_IPOC or (late is not None and int(late) > _LARGEST_DELAY):
            return None
        return Packet(ipoc, joints_deg, None if late is None else int(late))

    return parse


def controller_type(packet: bytes) -> bytes:
    """The Type (or TYPE) of the packet's root element; empty if it has none."""
    match = _TYPE.search(packet)
    return match[1] if match else b""


def answer_template(sen_type: str, correction_tag: str, names: tuple[str, ...], stop: str = "") -> bytes:
    """Return an answer with places for six corrections (floats) and the IPOC (bytes), for `%`. `stop` is the
    element that does or does not end the program."""
    values = " ".join(f'{name}="%.6f"' for name in names)
    return f'<Sen Type="{sen_type}"><EStr></EStr><{correction_tag} {values}/>{stop}<IPOC>%b</IPOC></Sen>'.encode()


def stop_element(stop_tag: str, *, stops: bool) -> str:
    """The element that ends the RSI program, if it is 1; "" without a tag."""
    return f"<{stop_tag}>{int(stops)}</{stop_tag}>" if stop_tag else ""
