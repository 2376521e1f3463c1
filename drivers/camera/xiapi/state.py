"""The state that a XIMEA camera must have, whatever its former state was. It is like `genicam_state`, with xiAPI's
names.

Parameters that the camera lacks are left out. If the camera has a parameter that does not take the value, this is
an error.
"""

from __future__ import annotations

import contextlib
from collections.abc import Collection
from dataclasses import dataclass

from coupole.errors import DeviceRefused
from drivers.camera.xiapi.device import XiDevice
from drivers.camera.xiapi.library import OVERLAP_READ_OUT, TRIGGER_STARTS_FRAME

_GPI_OFF = 0
"""XI_GPI_OFF."""
_GAIN_AS_A_WHOLE, _GAIN_STAGES = 0, (1, 2)
"""XI_GAIN_SELECTOR_ALL; ANALOG_ALL and DIGITAL_ALL."""


@dataclass(frozen=True)
class Line:
    """One line of the table: `parameter` is set to `value`, for each value of `selector` from 0 to `last`."""

    parameter: str
    value: int | float
    selector: str = ""
    last: int = 0


AT_OPENING = (
    # image: XI_DWN_1x1, XI_TESTPAT_OFF, XI_SHUTTER_GLOBAL
    Line("downsampling", 1),
    Line("binning_horizontal", 1, "binning_selector", 2),
    Line("binning_vertical", 1, "binning_selector", 2),
    Line("decimation_horizontal", 1, "decimation_selector", 2),
    Line("decimation_vertical", 1, "decimation_selector", 2),
    Line("horizontal_flip", 0),
    Line("vertical_flip", 0),
    Line("test_pattern", 0, "test_pattern_generator_selector", 1),
    Line("shutter_type", 0),
    Line("concat_img_mode", 0),
    # pixels
    Line("aeag", 0),
    Line("auto_wb", 0),
    Line("bpc", 0),
    Line("ffc", 0),
    Line("hdr", 0),
    Line("LUTEnable", 0),
    Line("gammaY", 1.0),
    Line("gammaC", 1.0),
    Line("trans_data_black_level_ovr_en", 0),
    # exposure: XI_ACQ_TIMING_MODE_FREE_RUN, XI_EXPOSURE_TIME_SELECTOR_COMMON, one exposure a frame
    Line("acq_timing_mode", 0),
    Line("exposure_time_selector", 0),
    Line("exposure_burst_count", 1),
    Line("interline_exposure_mode", 0),
)
FRAME_TRIGGER = (
    Line("trigger_selector", TRIGGER_STARTS_FRAME),
    # An edge that comes too early must be ignored: if latched (XI_TRG_OVERLAP_PREV_FRAME), it would start the
    # exposure late, under the light of another step.
    Line("trigger_overlap", OVERLAP_READ_OUT),
    Line("trigger_delay", 0),
    Line("dbnc_en", 0),
)
"""Parameters of the selected input, which starts frames."""


class State:
    """Sets parameters of an open camera, and keeps the values that were read back.

    `rigs` are parameters that belong to the rig; their lines are not used. Methods raise DeviceRefused or
    DeviceLost.
    """

    def __init__(self, device: XiDevice, rigs: Collection[str]) -> None:
        self._device, self._rigs = device, frozenset(rigs)
        self.held: dict[str, str] = {}
        """Values that were read back, by parameter or parameter[value of its selector]."""

    def apply(self, lines: Collection[Line]) -> None:
        """Set the parameters of these lines, in their order."""
        for line in lines:
            if line.parameter in self._rigs:
                continue
            if not line.selector or not self._device.has(line.selector):
                self.set_if_present(line.parameter, line.value)
                continue
            most = self._device.bounds(line.selector)[1]
            for entry in reversed(range(int(min(line.last, most)) + 1)):
                if self._select(line.selector, entry):
                    self.set_if_present(line.parameter, line.value, str(entry))

    def _select(self, selector: str, entry: int) -> bool:
        """False if this model has no such entry."""
        with contextlib.suppress(DeviceRefused):
            self._device.set(selector, entry)
            return True
        return False

    def set_if_present(self, parameter: str, value: int | float, entry: str = "") -> None:
        """Set a parameter as `set` does, if the model has it."""
        if self._device.has(parameter):
            self.set(parameter, value, entry)

    def set(self, parameter: str, value: int | float, entry: str = "") -> None:
        """Set a parameter, unless it has the value already. Raises DeviceRefused if it then has another value."""
        if self._present_value(parameter, value) != value:
            self._device.set(parameter, value)
        read_back = self._present_value(parameter, value)
        if read_back != value:
            raise DeviceRefused(
                self._device.name,
                expected=f"`{parameter}` to hold {value:g} once it is set",
                happened=f"it holds {read_back:g}",
                remedy="Name it under `leave` in the camera's settings of the rig if it may stay as it is.",
            )
        self.held[f"{parameter}[{entry}]" if entry else parameter] = f"{read_back:g}"

    def _present_value(self, parameter: str, value: int | float) -> float:
        return self._device.number(parameter) if isinstance(value, float) else self._device.whole(parameter)

    def note(self, *parameters: str) -> None:
        """Keep the values of these parameters, if the camera has them."""
        for parameter in parameters:
            if self._device.has(parameter):
                self.held[parameter] = f"{self._device.number(parameter):g}"

    def use_whole_sensor(self) -> None:
        """Read out one region of the largest size, with the present binning."""
        for offset, size in (("offsetX", "width"), ("offsetY", "height")):
            if offset not in self._rigs:
                self.set(offset, 0)
            if size not in self._rigs:
                self.set(size, int(self._device.bounds(size)[1]))

    def free_other_inputs(self, trigger_input: int) -> None:
        """Let no input trigger frames but the box's input."""
        if {"gpi_selector", "gpi_mode"} & self._rigs:
            return
        low, high = self._device.bounds("gpi_selector")
        for number in range(int(max(1.0, low)), int(min(high, 12.0)) + 1):
            if number != trigger_input and self._select("gpi_selector", number):
                self.set("gpi_mode", _GPI_OFF, str(number))

    def neutralise_gains(self) -> None:
        """Set analogue and digital gain to 0 dB each, or their least. Then select the gain as a whole."""
        if {"gain", "gain_selector"} & self._rigs or not self._device.has("gain_selector"):
            return
        for entry in _GAIN_STAGES:
            if self._select("gain_selector", entry):
                self.set("gain", max(0.0, self._device.bounds("gain")[0]), str(entry))
        self._device.set("gain_selector", _GAIN_AS_A_WHOLE)
