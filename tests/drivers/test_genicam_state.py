"""The table of a GenICam camera's state, on a camera in memory that has features which the stand-ins lack."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import pytest

from coupole.errors import DeviceRefused
from drivers.camera.aravis.settings import Settings
from drivers.camera.genicam_image import set_up
from drivers.camera.genicam_settings import Value

SENSOR_PX = {"Width": 4096, "Height": 3072}


@dataclass
class MemoryFeatures:
    """`drivers.camera.genicam_features.Features` of a camera whose features hold what is written.

    A feature with a selector has one value for each of its entries: `values["LUTEnable[Red]"]`.
    """

    values: dict[str, Value]
    choices: dict[str, list[str]] = field(default_factory=dict)
    selector_of: dict[str, str] = field(default_factory=dict)
    stuck: set[str] = field(default_factory=set)
    written: list[str] = field(default_factory=list)

    def _key(self, name: str) -> str:
        selector = self.selector_of.get(name)
        return f"{name}[{self.values[selector]}]" if selector else name

    def has(self, name: str) -> bool:
        return self._key(name) in self.values

    def first_of(self, *names: str) -> str | None:
        return next((name for name in names if self.has(name)), None)

    def read_value(self, name: str) -> Value:
        return self.values[self._key(name)]

    def number(self, name: str) -> float:
        value = self.read_value(name)
        assert not isinstance(value, str)
        return value

    def bounds(self, name: str) -> tuple[float, float]:
        return 0.0, 100.0

    def largest(self, name: str) -> int:
        return SENSOR_PX[name]

    def entries(self, name: str) -> list[str]:
        return self.choices.get(name, [str(self.read_value(name))])

    def write(self, name: str, value: Value) -> None:
        self.written.append(name)
        if name in self.stuck or (name in self.choices and value not in self.choices[name]):
            raise DeviceRefused("camera", expected=f"`{name}`", happened=f"{value!r}", remedy="")
        self.values[self._key(name)] = value

    def write_all(self, values: Any) -> None:
        for name, value in values.items():
            self.write(name, value)


PLAIN: dict[str, Value] = {
    "PixelFormat": "BayerGB12",
    "Width": 64,
    "Height": 64,
    "TriggerMode": "Off",
    "TriggerSource": "Software",
}
ON_OFF = ["Off", "On"]
LEFT_AND_RIGHT: list[tuple[str, Value, Value, list[str]]] = [
    ("SequencerMode", "On", "Off", ON_OFF),
    ("SequencerConfigurationMode", "On", "Off", ON_OFF),
    ("TransferControlMode", "UserControlled", "Basic", ["Basic", "Automatic", "UserControlled"]),
    ("ChunkModeActive", True, False, []),
    ("ImageCompressionMode", "JPEG", "Off", ["Off", "JPEG"]),
    ("PtpEnable", True, False, []),
    ("GevIEEE1588", True, False, []),
    ("DeviceScanType", "Linescan", "Areascan", ["Areascan", "Linescan"]),
    ("SensorShutterMode", "Rolling", "Global", ["Global", "Rolling"]),
    ("TestImageSelector", "Testimage1", "Off", ["Off", "Testimage1"]),
    ("BlackLevelAuto", "Continuous", "Off", ["Off", "Continuous"]),
    ("BalanceWhiteAuto", "Continuous", "Off", ["Off", "Continuous"]),
    ("ColorTransformationEnable", True, False, []),
    ("Gamma", 0.45, 1.0, []),
    ("ExposureTimeMode", "Individual", "Common", ["Common", "Individual"]),
    ("ExposureTimeSelector", "Red", "Common", ["Common", "Red"]),
    ("AcquisitionFrameRateEnabled", True, False, []),
    ("TriggerDelayAbs", 5000.0, 0.0, []),
    ("TriggerMultiplier", 3, 1, []),
    ("TriggerOverlap", "PreviousFrame", "Off", ["Off", "PreviousFrame"]),
]
"""Feature, what it was left in, what it must be, entries of an enumeration."""


def up(camera: MemoryFeatures, **settings: Any) -> dict[str, str]:
    return set_up(camera, Settings(**settings), is_triggered=True)


@pytest.mark.parametrize(("name", "left", "right", "entries"), LEFT_AND_RIGHT)
def test_each_feature_is_set_and_noted(name: str, left: Value, right: Value, entries: list[str]) -> None:
    camera = MemoryFeatures({**PLAIN, name: left}, {name: entries} if entries else {})
    held = up(camera)
    assert camera.values[name] == right
    assert held[name] == str(right)


@pytest.mark.parametrize(("name", "left", "right", "entries"), LEFT_AND_RIGHT)
def test_a_feature_that_refuses_is_an_error(name: str, left: Value, right: Value, entries: list[str]) -> None:
    camera = MemoryFeatures({**PLAIN, name: left}, {name: entries} if entries else {}, stuck={name})
    with pytest.raises(DeviceRefused, match=name):
        up(camera)


def test_a_feature_that_is_right_is_not_written() -> None:
    """It may be locked."""
    camera = MemoryFeatures({**PLAIN, "SensorShutterMode": "Global"}, stuck={"SensorShutterMode"})
    assert up(camera)["SensorShutterMode"] == "Global"


def test_a_shutter_that_is_rolling_only_is_noted() -> None:
    camera = MemoryFeatures({**PLAIN, "SensorShutterMode": "Rolling"}, {"SensorShutterMode": ["Rolling"]})
    assert up(camera)["SensorShutterMode"] == "Rolling"


def test_a_feature_that_the_rig_leaves_stays_and_is_noted() -> None:
    camera = MemoryFeatures({**PLAIN, "PtpEnable": True}, stuck={"PtpEnable"})
    assert up(camera, leave=["PtpEnable"])["PtpEnable"] == "True"


def test_a_feature_that_the_rig_sets_is_the_rigs() -> None:
    camera = MemoryFeatures({**PLAIN, "BinningHorizontal": 1})
    assert up(camera, features={"BinningHorizontal": 2})["BinningHorizontal"] == "2"
    assert camera.written.count("BinningHorizontal") == 1


def test_a_feature_with_a_selector_is_set_for_each_entry() -> None:
    camera = MemoryFeatures(
        {**PLAIN, "LUTSelector": "Red", "LUTEnable[Red]": True, "LUTEnable[Luminance]": True},
        {"LUTSelector": ["Luminance", "Red"]},
        {"LUTEnable": "LUTSelector"},
    )
    held = up(camera)
    assert (held["LUTEnable[Luminance]"], held["LUTEnable[Red]"]) == ("False", "False")
    assert (camera.values["LUTEnable[Luminance]"], camera.values["LUTEnable[Red]"]) == (False, False)


def test_a_feature_that_only_some_entries_of_its_selector_have_is_found() -> None:
    camera = MemoryFeatures(
        {**PLAIN, "BinningSelector": "Sensor", "BinningVertical[Region0]": 2},
        {"BinningSelector": ["Sensor", "Region0"]},
        {"BinningVertical": "BinningSelector"},
    )
    up(camera)
    assert camera.values["BinningVertical[Region0]"] == 1


def test_all_triggers_but_that_of_frames_are_off() -> None:
    starts = ["AcquisitionStart", "FrameBurstStart", "FrameStart"]
    camera = MemoryFeatures(
        {
            **{name: value for name, value in PLAIN.items() if not name.startswith("Trigger")},
            "TriggerSelector": "FrameBurstStart",
            **{f"TriggerMode[{start}]": "On" for start in starts},
            **{f"TriggerSource[{start}]": "Line3" for start in starts},
        },
        {"TriggerSelector": starts},
        {"TriggerMode": "TriggerSelector", "TriggerSource": "TriggerSelector"},
    )
    up(camera)
    assert [camera.values[f"TriggerMode[{start}]"] for start in starts] == ["Off", "Off", "On"]
    assert camera.values["TriggerSource[FrameStart]"] == "Line0"


def test_gains_of_stages_and_channels_are_zero_and_the_whole_is_selected() -> None:
    stages = ["DigitalAll", "Tap1", "AnalogAll"]
    camera = MemoryFeatures(
        {**PLAIN, "GainSelector": "DigitalAll", **{f"Gain[{stage}]": 6.0 for stage in stages}},
        {"GainSelector": stages},
        {"Gain": "GainSelector"},
    )
    up(camera)
    assert camera.values["GainSelector"] == "AnalogAll"
    assert [camera.values[f"Gain[{stage}]"] for stage in stages] == [0.0, 6.0, 6.0]


def test_one_region_and_one_component_are_on() -> None:
    regions, components = ["Region0", "Region1"], ["Range", "Intensity"]
    camera = MemoryFeatures(
        {
            **PLAIN,
            "RegionSelector": "Region1",
            "RegionMode[Region0]": "Off",
            "RegionMode[Region1]": "On",
            "ComponentSelector": "Range",
            "ComponentEnable[Range]": True,
            "ComponentEnable[Intensity]": False,
        },
        {"RegionSelector": regions, "ComponentSelector": components},
        {"RegionMode": "RegionSelector", "ComponentEnable": "ComponentSelector"},
    )
    up(camera)
    assert [camera.values[f"RegionMode[{region}]"] for region in regions] == ["On", "Off"]
    assert [camera.values[f"ComponentEnable[{component}]"] for component in components] == [False, True]
    assert (camera.values["RegionSelector"], camera.values["ComponentSelector"]) == ("Region0", "Intensity")


def test_the_trigger_line_is_an_input_and_not_inverted() -> None:
    lines = ["Line0", "Line1"]
    camera = MemoryFeatures(
        {
            **PLAIN,
            "LineSelector": "Line1",
            **{f"LineMode[{line}]": "Output" for line in lines},
            **{f"LineInverter[{line}]": True for line in lines},
        },
        {"LineSelector": lines, "LineMode": ["Input", "Output"]},
        {"LineMode": "LineSelector", "LineInverter": "LineSelector"},
    )
    up(camera)
    assert (camera.values["LineMode[Line0]"], camera.values["LineInverter[Line0]"]) == ("Input", False)
    assert (camera.values["LineMode[Line1]"], camera.values["LineInverter[Line1]"]) == ("Output", True)


def test_the_whole_sensor_is_read_out() -> None:
    camera = MemoryFeatures({**PLAIN, "OffsetX": 8, "OffsetY": 8})
    held = up(camera)
    assert (camera.values["Width"], camera.values["Height"]) == (4096, 3072)
    assert (camera.values["OffsetX"], camera.values["OffsetY"]) == (0, 0)
    assert held["Width"] == "4096"
