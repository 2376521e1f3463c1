"""The state that a GenICam camera must have, whatever its former state was. There is one table for all GenICam
drivers.

A camera keeps the settings of the last program, and some cameras keep them over power-off. So each feature that
affects the exposure of a frame or its pixels is set and read back when the camera is opened. Names and entries
follow the GenICam Standard Features Naming Convention (SFNC) 2.7. A feature that the camera lacks is left out. If
the camera has a feature that does not take the value, this is an error. Features named in the rig (`features`, or
`leave`) belong to the rig, and their lines of the table are not used.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from dataclasses import dataclass

from drivers.camera.genicam_features import Features, alike
from drivers.camera.genicam_settings import GenICamSettings, Value


@dataclass(frozen=True)
class Line:
    """The first of `names` that the camera has is set to the first of `values` that the camera offers."""

    names: tuple[str, ...]
    values: tuple[Value, ...]
    selector: str = ""
    """Selector feature: the feature is set for each of its entries, if the camera has the selector."""
    if_offered: bool = False
    """True: an enumeration without any of the values stays unchanged."""


def _line(name: str, value: Value, selector: str = "") -> Line:
    return Line((name,), (value,), selector)


AT_OPENING = (
    _line("SequencerMode", "Off"),
    _line("SequencerConfigurationMode", "Off"),
    # transport
    Line(("TransferControlMode",), ("Basic", "Automatic")),
    _line("ChunkModeActive", False),
    _line("ImageCompressionMode", "Off"),
    _line("PtpEnable", False),
    _line("GevIEEE1588", False),
    # image
    Line(("DeviceScanType",), ("Areascan",), if_offered=True),
    Line(("SensorShutterMode",), ("Global",), if_offered=True),
    _line("BinningHorizontal", 1, "BinningSelector"),
    _line("BinningVertical", 1, "BinningSelector"),
    _line("DecimationHorizontal", 1),
    _line("DecimationVertical", 1),
    _line("ReverseX", False),
    _line("ReverseY", False),
    _line("TestPattern", "Off", "TestPatternGeneratorSelector"),
    _line("TestImageSelector", "Off"),
    # pixels
    _line("BlackLevelAuto", "Off"),
    _line("BalanceWhiteAuto", "Off"),
    _line("BalanceRatio", 1.0, "BalanceRatioSelector"),
    Line(("GammaEnable", "Gamma"), (False, 1.0)),
    _line("LUTEnable", False, "LUTSelector"),
    _line("ColorTransformationEnable", False),
    _line("GainAuto", "Off"),
    # exposure
    _line("AcquisitionMode", "Continuous"),
    Line(("AcquisitionFrameRateEnable", "AcquisitionFrameRateEnabled"), (False,)),
    _line("ExposureAuto", "Off"),
    _line("ExposureMode", "Timed"),
    _line("ExposureTimeMode", "Common"),
    Line(("ExposureTimeSelector",), ("Common",), if_offered=True),
    _line("TriggerMode", "Off", "TriggerSelector"),
)
FRAME_TRIGGER = (
    Line(("TriggerDelay", "TriggerDelayAbs"), (0.0,)),
    # An early edge is ignored and counted. If latched (PreviousFrame), it would expose later, under another light.
    Line(("TriggerOverlap",), ("ReadOut", "Off")),
    _line("TriggerDivider", 1),
    _line("TriggerMultiplier", 1),
)
"""Features of the trigger that starts frames. They are set after the trigger is on, because some cameras do not
allow them before."""
TRIGGER_LINE = (
    Line(("LineMode",), ("Input",)),
    _line("LineInverter", False),
)
"""Features of the line on which the trigger comes."""
_ONE_OF_SEVERAL = (
    ("RegionSelector", "RegionMode", "Region0"),
    ("ComponentSelector", "ComponentEnable", "Intensity"),
)
"""A selector, the feature that switches the selected entry on, and the only entry that is to be on."""
_WHOLE_GAINS = ("All", "AnalogAll")
_ALSO_READ = (
    "PixelFormat",
    "Width",
    "Height",
    "OffsetX",
    "OffsetY",
    "BlackLevel",
    "SensorReadoutTime",
    "DeviceLinkThroughputLimitMode",
    "DeviceLinkThroughputLimit",
    "GevSCPD",
    "GevSCPSPacketSize",
)


class State:
    """Sets features of an open camera, and keeps the values that were read back.

    Each method raises DeviceRefused if the camera has the feature and does not take the value, DeviceLost.
    """

    def __init__(self, features: Features, settings: GenICamSettings) -> None:
        self._features = features
        self._rigs = {*settings.features, *settings.leave}
        self.held: dict[str, str] = {}
        """Values that were read back, by feature or feature[entry of its selector]."""

    def apply(self, lines: Collection[Line]) -> None:
        """Set the features of these lines, in their order."""
        for line in lines:
            self._apply(line)

    def set(self, name: str, value: Value, entry: str = "") -> None:
        """Set a feature, unless it has the value already, and keep the value that it then has."""
        read_back = self._features.read_value(name)
        if not alike(read_back, value):
            self._features.write(name, value)
            read_back = self._features.read_value(name)
        self.held[f"{name}[{entry}]" if entry else name] = str(read_back)

    def select(self, selector: str, entry: str) -> None:
        """Select an entry, if the camera has it; raises DeviceRefused if the selector lacks it."""
        if self._features.has(selector):
            self._features.write(selector, entry)

    def note(self, *names: str) -> None:
        """Keep the values of these features, if the camera has them."""
        for name in names:
            if self._features.has(name):
                self.held[name] = str(self._features.read_value(name))

    def note_all(self) -> None:
        """Keep other informative values, if the camera has them."""
        self.note(*_ALSO_READ)

    def use_one_region_and_component(self) -> None:
        """Switch off all regions of the sensor but the first, and all components of an image but intensity."""
        for selector, switch, preference in _ONE_OF_SEVERAL:
            if selector in self._rigs or switch in self._rigs or not self._features.has(selector):
                continue
            entries = self._features.entries(selector)
            entry_in_use = preference if preference in entries else entries[0]
            for entry in sorted(entries, key=lambda entry: entry == entry_in_use):
                self._features.write(selector, entry)
                if self._features.has(switch):
                    self.set(switch, self._switch_value(switch, on=entry == entry_in_use), entry)

    def _switch_value(self, name: str, *, on: bool) -> Value:
        if isinstance(self._features.read_value(name), bool):
            return on
        return "On" if on else "Off"

    def neutralise_gains(self) -> None:
        """Set the gains of single channels and stages to 0 dB, or their least, and select the gain as a whole."""
        features = self._features
        if {"Gain", "GainSelector"} & self._rigs or not features.has("GainSelector"):
            return
        entries = features.entries("GainSelector")
        whole = next((entry for entry in _WHOLE_GAINS if entry in entries), entries[0])
        for entry in entries:
            if entry != whole and not entry.startswith("Tap"):
                features.write("GainSelector", entry)
                if features.has("Gain"):
                    self.set("Gain", max(0.0, features.bounds("Gain")[0]), entry)
        features.write("GainSelector", whole)

    def use_whole_sensor(self) -> None:
        """Read out the whole sensor, with the present binning."""
        for offset, size in (("OffsetX", "Width"), ("OffsetY", "Height")):
            if self._features.has(offset) and offset not in self._rigs:
                self.set(offset, 0)
            if size not in self._rigs:
                largest = self._features.largest(size)
                if largest < 2**31:  # otherwise the camera does not report it
                    self.set(size, largest)

    def _apply(self, line: Line) -> None:
        if self._rigs.intersection(line.names):
            return
        name = next((name for name in line.names if self._has(name, line.selector)), None)
        if name is None:
            return
        for entry in self._entries_of(line.selector):
            if self._features.has(name):  # these may depend on the selected entry
                self._set_first(line, name, entry)

    def _has(self, name: str, selector: str) -> bool:
        """True if the camera has the feature, if only for some entries of its selector."""
        return self._features.has(name) or any(self._features.has(name) for _ in self._entries_of(selector))

    def _entries_of(self, selector: str) -> Iterator[str]:
        """Yield each entry of the selector, which is selected in turn. Without a selector, yield the empty text
        once."""
        if not selector or selector in self._rigs or not self._features.has(selector):
            yield ""
            return
        for entry in self._features.entries(selector):
            self._features.write(selector, entry)
            yield entry

    def _set_first(self, line: Line, name: str, entry: str) -> None:
        """Set the feature to the first suitable value of the line."""
        value = line.values[min(line.names.index(name), len(line.values) - 1)]
        if isinstance(value, str):
            entries = self._features.entries(name)
            fitting = [candidate for candidate in line.values if candidate in entries]
            if line.if_offered and not fitting:
                self.note(name)
                return
            value = fitting[0] if fitting else value
        self.set(name, _in_type_of(value, self._features.read_value(name)), entry)


def _in_type_of(value: Value, readback: Value) -> Value:
    """Return a number in the type of the camera's feature."""
    if isinstance(value, float) and isinstance(readback, int) and math.isfinite(value):
        return int(value)
    if isinstance(value, bool) and not isinstance(readback, bool) and isinstance(readback, int | str):
        return ("On" if value else "Off") if isinstance(readback, str) else int(value)
    return value
