"""RSI packets and answers on the stand-in's side, written independently of the drivers."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Iterable
from typing import NamedTuple

from coupole.geometry import abc_from_rotation
from sim.devices.kuka_kinematics import flange_pose
from sim.devices.kuka_settings import Settings

VALUE_NAMES = {"axes": ("A1", "A2", "A3", "A4", "A5", "A6"), "pose": ("X", "Y", "Z", "A", "B", "C")}
TAGS = {"axes": "AKorr", "pose": "RKorr"}

_PAIR = re.compile(rb'(\w+)="([^"]*)"')
_IPOC = re.compile(rb"<IPOC>(\d+)</IPOC>")
_POSE_XML = b'<RIst X="%.4f" Y="%.4f" Z="%.4f" A="%.4f" B="%.4f" C="%.4f"/>'


class Answer(NamedTuple):
    ipoc: int
    values: tuple[float, ...]
    """Six corrections, degrees or millimetres; a missing one is 0."""
    stops: bool = False
    """True if the program is to end."""
    remark: str = ""
    """Remark about a possible mistake of the client; empty if all is as configured."""


class Unread(NamedTuple):
    """Data that are not an answer to this controller."""

    reason: str
    details: str


def answer_reader(settings: Settings) -> Callable[[bytes], Answer | Unread]:
    """Return a parser of answers."""
    tag = re.escape(settings.correction_tag or TAGS[settings.corrects]).encode()
    names = [name.encode() for name in VALUE_NAMES[settings.corrects]]
    begins = re.compile(rb'<Sen\b[^>]*\bType="%s"' % re.escape(settings.sen_type).encode())
    correction = re.compile(rb"<%s\s([^>]*)/>" % tag)
    stop = re.compile(rb"<%s>\s*(?:1|TRUE)\s*<" % re.escape(settings.stop_tag).encode(), re.IGNORECASE)
    ends = bool(settings.stop_tag)
    in_order = re.compile(rb"<%s " % tag + rb" ".join(rb'%s="([^"]+)"' % name for name in names) + rb"\s*/>")

    def read_answer(data: bytes) -> Answer | Unread:
        ipoc, text = _IPOC.search(data), data[:200].decode(errors="replace")
        if ipoc is None:
            return Unread("an answer without IPOC is ignored", text)
        if not begins.search(data):
            return Unread(f"an answer whose SENTYPE is not {settings.sen_type} is ignored", text)
        stops = ends and stop.search(data) is not None
        try:
            if values := in_order.search(data):
                return Answer(int(ipoc[1]), _finite(values.groups()), stops)
            correction_match = correction.search(data)
            pairs = dict(_PAIR.findall(correction_match[1])) if correction_match else {}
            missing = [name.decode() for name in names if name not in pairs]
            remark = f"corrections without {' '.join(missing)} in {tag.decode()} are taken as 0" if missing else ""
            return Answer(int(ipoc[1]), _finite(pairs.get(name, b"0") for name in names), stops, remark)
        except ValueError:
            return Unread("an answer with a correction that is not a number is ignored", text)

    return read_answer


def _finite(texts: Iterable[bytes]) -> tuple[float, ...]:
    """Return the numbers. Raises ValueError for text that is not a number, or that no axis can have."""
    numbers = tuple(map(float, texts))
    if not all(map(math.isfinite, numbers)):
        raise ValueError(numbers)
    return numbers


class PacketWriter:
    """Forms packets. The part with the axes is formatted again only when they have moved."""

    def __init__(self, settings: Settings) -> None:
        axes = " ".join(f'A{axis}="%.4f"' for axis in range(1, 7))
        self._axes_xml = f"<{settings.measured_tag} {axes}/>".encode()
        self._sends_delay, self._sends_pose = bool(settings.delay_tag), settings.sends_pose
        self._delay_xml = f'<{settings.delay_tag} D="%d"/>'.encode()
        self._axes_deg: tuple[float, ...] = ()
        self._place = b""

    def packet(self, axes_deg: tuple[float, ...], delay: int, ipoc: int) -> bytes:
        if axes_deg != self._axes_deg:
            self._axes_deg, self._place = axes_deg, self._axes_xml % axes_deg
            if self._sends_pose:
                pose = flange_pose(axes_deg)
                self._place = _POSE_XML % (*pose[:3, 3], *abc_from_rotation(pose[:3, :3])) + self._place
        late = self._delay_xml % delay if self._sends_delay else b""
        return b'<Rob Type="KUKA simulated">%b%b<IPOC>%d</IPOC></Rob>' % (self._place, late, ipoc)
