"""KUKA RSI's packets: reads those of the controller, and forms the answers.

The names of elements are set in the controller's RSI configuration, so they are parameters here.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from typing import NamedTuple


class Packet(NamedTuple):
    ipoc: bytes
    """As received, to be sent back unchanged."""
    joints_deg: tuple[float, ...]
    delay: int | None
    """The counter of late answers; None where the controller does not send it."""


_ATTRIBUTE = re.compile(rb"""([A-Za-z_]\w*)\s*=\s*["']\s*([^"']*?)\s*["']""")
_TYPE = re.compile(rb"""<Rob\b[^>]*?\bTYPE\s*=\s*["']([^"']*)["']""", re.IGNORECASE)


def packet_parser(measured_tag: str, delay_tag: str) -> Callable[[bytes], Packet | None]:
    """A parser of the controller's packets: elements and attributes in any order, unknown ones ignored.

    It returns None if IPOC or an axis is missing or not a number.
    """
    measured, delay = re.escape(measured_tag).encode(), re.escape(delay_tag).encode()
    usual_axes = re.compile(
        rb"<%s " % measured + rb" ".join(rb'A%d="([^"]+)"' % axis for axis in range(1, 7)) + rb"\s*/>"
    )
    any_axes = re.compile(rb"<%s\b([^>]*)>" % measured)
    usual_tail = re.compile(rb'<%s D="(\d+)"\s*/>\s*<IPOC>(\d+)</IPOC>' % delay)
    any_delay = re.compile(rb"""<%s\b[^>]*?\bD\s*=\s*["']\s*(\d+)\s*["']""" % delay)
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
        if not math.isfinite(sum(joints_deg)):
            return None
        if match := usual_tail.search(packet):
            return Packet(match[2], joints_deg, int(match[1]))
        ipoc = any_ipoc.search(packet)
        late = any_delay.search(packet)
        return Packet(ipoc[1], joints_deg, int(late[1]) if late else None) if ipoc else None

    return parse


def controller_type(packet: bytes) -> bytes:
    """The Type (or TYPE) of the packet's root element; empty if it has none."""
    match = _TYPE.search(packet)
    return match[1] if match else b""


def answer_template(sen_type: str, correction_tag: str, names: tuple[str, ...]) -> bytes:
    """An answer with places for six corrections (floats) and the IPOC (bytes), for `%`."""
    values = " ".join(f'{name}="%.6f"' for name in names)
    return f'<Sen Type="{sen_type}"><EStr></EStr><{correction_tag} {values}/><IPOC>%b</IPOC></Sen>'.encode()
