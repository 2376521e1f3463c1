"""The LED control box, by SCPI over a serial line or USBTMC (docs/reference/ledbox-protocol.md).

Every message ends in `SYSTem:ERRor?`, so every command is confirmed and costs one round trip. The box's two table
banks are used alternately. While one table runs, the next table is uploaded into the other bank, in blocks; other
messages pass between the blocks. `lights_off` waits for no message, because it begins with a device clear.
"""

from __future__ import annotations

import contextlib
import zlib
from collections.abc import Mapping
from dataclasses import astuple
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from coupole.clock import Clock, Deadline
from coupole.devices import STEP_DTYPE, Identity, Step, StepRecord
from coupole.errors import DeviceError, DeviceFault, DeviceRefused, DeviceTimeout
from drivers.ledbox.link import CallEnded, Link
from drivers.ledbox.scpi import REPLY_MARGIN_S, ScpiSession
from drivers.ledbox.serial_link import no_port, open_serial
from drivers.ledbox.settings import BLOCK_BYTES, Settings
from drivers.ledbox.usbtmc import UsbtmcLink
from drivers.ledbox.wire import RECORD_BYTES, pack, unpack_log
from drivers.opening import closed_on_failure

_BLOCK_TIMEOUT_S = 2.2
"""Silence after which the box has discarded an incomplete block (its own limit is 2 s)."""
_POLL_S, _POLL_OVERHEAD_BYTES = 0.055, 130
"""Duration of a poll during a burst, and its bytes on the line apart from records."""
_MAX_RECORDS_PER_POLL = 512
_UNDEFINED_HEADER, _HARDWARE_MISSING, _FIRST_PROTOCOL = "-113", "-241", "1.0"
_CLEARS_AT_ONCE = 5
"""Number of threads that may switch the lights off at the same time. Each of these threads clears the box, which
ends the messages of the others.
"""
_SHORTEST_PERIOD_US = 100
_FLASH_MARGIN_S = 5.0
"""A flash that lasts longer than requested by this time counts as not ended."""


class LedBox:
    """The box: a `coupole.devices.TableLedBox`.

    Opening resets it, which also clears a latched fault of the box (watchdog, over-temperature).
    Each call may raise DeviceTimeout, DeviceLost, DeviceRefused (with the box's error), DeviceFault, or another
    DeviceError if `lights_off` was called meanwhile.
    """

    runs_tables = True
    panel_count = 4

    def __init__(self, settings: Settings, clock: Clock) -> None:
        self._settings, self._clock = settings, clock
        self._banks: list[bytes | None] = [None, None]
        self._last_loaded = 1
        self._running_bank: int | None = None
        self._started: NDArray[np.void] = np.empty(0, STEP_DTYPE)
        self._next_record = 0
        self._protocol = _FIRST_PROTOCOL
        self._scpi = ScpiSession(settings.name, settings.port, self._open(), clock)
        with closed_on_failure(self.close):
            self._identity = self._greet()
            self._protocol = self._ask_protocol()
            self._has_enabling_switch = self._ask_enabling_switch()
            self.led_count = self._set_up()

    def identify(self) -> Identity:
        return self._identity

    def self_test(self) -> Mapping[str, str]:
        """State, hottest board and settings; raises DeviceFault if a fault is latched."""
        state, celsius, watchdog_s = self._scpi.ask("SEQ:STAT?;:MEAS:TEMP?;:SYST:WATC?", 3)
        if state == "FAULT":
            self._raise_fault("the box reports FAULT")
        return {
            "state": str(state),
            "LEDs": str(self.led_count),
            "hottest board": f"{self._scpi.number(celsius)} C",
            "watchdog": f"{self._scpi.number(watchdog_s):g} s",
            "enabling switch": {None: "no input for one", True: "held", False: "released"}[self.presence()],
            "device clear": "yes" if self._clears else f"no: the box speaks protocol {self._protocol}",
        }

    def load(self, table: NDArray[np.void]) -> None:
        """Upload into the bank that is not running. At 115200 baud 1080 records take 1.8 s, or longer while other
        threads poll between their blocks."""
        payload = self._payload(table)
        if payload in self._banks:
            return
        bank = 1 - (self._last_loaded if self._running_bank is None else self._running_bank)
        with self._scpi.call():
            self._upload(bank, payload)

    def start(self, table: NDArray[np.void]) -> None:
        """Run a loaded table. If a bank has a wrong CRC-32, it is uploaded once more; if it is still wrong, it is
        refused."""
        payload = self._payload(table)
        with self._scpi.call():
            self._start(payload, table)

    def poll_log(self) -> NDArray[np.void]:
        """New records, STEP_RECORD_DTYPE [k]: all steps that had finished when the last round trip of this call
        began. At 115200 baud one round trip takes 60 ms, which keeps up with 100 steps per second."""
        more, records = self._poll()
        parts = [records]
        while more:
            more, records = self._poll()
            parts.append(records)
        return np.concatenate(parts)

    def running(self) -> bool:
        (state,) = self._scpi.ask("SEQ:STAT?", 1)
        return self._note_state(str(state))

    def edges(self) -> int:
        (count,) = self._scpi.ask("TRIG:COUN?", 1)
        return int(self._scpi.number(count))

    def flash(self, led: int, on_us: int) -> None:
        """Run a table of one step without an edge. The box times the flash, and the table runs as long as the LED
        is lit."""
        step = Step(led, on_us, 0, max(on_us, _SHORTEST_PERIOD_US), sends_edge=False)
        table = np.array([astuple(step)], STEP_DTYPE)
        with self._scpi.call():
            self.load(table)
            self.start(table)

    def lit(self) -> bool:
        return self.running()

    def end_flash(self) -> StepRecord:
        """Wait until the box reports that the step has ended, and read its record."""
        on_s = float(self._started["on_us"].sum()) * 1e-6
        deadline = Deadline(self._clock, on_s + _FLASH_MARGIN_S)
        with self._scpi.call():
            return self._await_end(on_s, deadline)

    def _await_end(self, on_s: float, deadline: Deadline) -> StepRecord:
        while self.running():
            if deadline.has_expired:
                raise DeviceTimeout(
                    self._settings.name,
                    expected=f"a light of {on_s:.3f} s to end within {deadline.seconds:.1f} s",
                    happened="the box still reports that it is running",
                    remedy="Check the box, then resume the run.",
                )
            self._clock.sleep(on_s / 10)
        records = self.poll_log()
        if len(records) != 1:
            self._scpi.raise_unexpected("one record in the log of a table with one step", f"{len(records)} came")
        return StepRecord(*records[0].tolist())

    def lights_off(self) -> None:
        """Send a device clear, which makes the box dark whatever it is being sent. Then abort, and wait for the
        confirmation. Calls of other threads end with DeviceError, and give no more light.

        A box without a device clear first gets the rest of the message that is being sent. Raises only if a second
        try fails too; by then such a box has discarded an incomplete upload. It takes about 5 s at most.
        """
        self._running_bank = None
        if self._clears:
            with contextlib.suppress(DeviceError):  # a lost link is reported below
                self._scpi.device_clear()
        else:
            self._scpi.end_calls()
        try:
            self._abort()
        except DeviceTimeout:
            self._clock.sleep(_BLOCK_TIMEOUT_S - REPLY_MARGIN_S)
            self._abort()

    def acknowledge(self) -> None:
        """Clear the box's faults. The box forgets its tables too."""
        self._running_bank, self._banks = None, [None, None]
        self._scpi.ask("*RST;*CLS", 0)
        self._set_up()

    def panel(self, panel: int, on: bool) -> None:
        self._scpi.ask(f"OUTP:PAN{panel} {int(on)}", 0)

    def board_temperature_c(self, board: int) -> float:
        (celsius,) = self._scpi.ask(f"MEAS:TEMP? (@{board})", 1)
        return self._scpi.number(celsius)

    def presence(self) -> bool | None:
        if not self._has_enabling_switch:
            return None
        (switch_state,) = self._scpi.ask("INP:ENAB?", 1)
        if switch_state not in ("0", "1"):
            self._scpi.raise_unexpected("0 or 1 in the answer to INPut:ENABle?", repr(switch_state))
        return switch_state == "1"

    def close(self) -> None:
        """Switch the lights off if the box still answers. Never raises for a lost link."""
        with contextlib.suppress(DeviceError):
            self.lights_off()
        self._scpi.close()

    def _abort(self) -> None:
        for _ in range(_CLEARS_AT_ONCE):
            with contextlib.suppress(CallEnded):  # another thread's lights_off has ended this call: ask again
                with contextlib.suppress(DeviceFault, DeviceRefused):  # the errors are older: ABORt was executed
                    self._scpi.ask("ABOR", 0)
                return

    # Opening.

    def _open(self) -> Link:
        settings = self._settings
        if not settings.port.startswith("usbtmc:"):
            return open_serial(settings.name, settings.port, settings.baud, self._clock)
        try:
            vendor, product, *serial = settings.port.split(":")[1:]
            return UsbtmcLink(int(vendor, 16), int(product, 16), ":".join(serial) or None, self._clock)
        except (ConnectionError, ValueError) as error:
            raise no_port(settings.name, settings.port, error) from error

    def _greet(self) -> Identity:
        """Discard the rest of an earlier program's messages in box and line, and read the box's identity. Read it
        once more if a late answer to an earlier message comes in its place."""
        try:
            self._scpi.ask("*CLS", 0)
        except DeviceTimeout:
            self._clock.sleep(_BLOCK_TIMEOUT_S - REPLY_MARGIN_S)
        try:
            (text,) = self._scpi.ask("*RST;*CLS;*IDN?", 1)
        except DeviceError as error:
            if type(error) not in (DeviceTimeout, DeviceError):
                raise
            self._clock.sleep(_BLOCK_TIMEOUT_S - REPLY_MARGIN_S)
            (text,) = self._scpi.ask("*RST;*CLS;*IDN?", 1)
        fields = str(text).split(",")
        if len(fields) != 4:
            self._scpi.raise_unexpected("four fields in the answer to *IDN?", repr(text))
        vendor, model, serial, firmware = fields
        return Identity(vendor, model, serial, firmware, simulated=serial.startswith("SIM"))

    def _ask_protocol(self) -> str:
        """Return the version of the box's protocol. A box of the first version cannot be asked."""
        try:
            (version,) = self._scpi.ask("SYST:PROT?", 1)
        except DeviceRefused as refused:
            if _UNDEFINED_HEADER not in refused.happened:
                raise
            return _FIRST_PROTOCOL
        return str(version)

    def _ask_enabling_switch(self) -> bool:
        """Ask whether the box has an input for an enabling switch. Older firmware does not know the question."""
        try:
            self._scpi.ask("INP:ENAB?", 1)
        except DeviceRefused as refused:
            if not any(code in refused.happened for code in (_UNDEFINED_HEADER, _HARDWARE_MISSING)):
                raise
            return False
        return True

    @property
    def _clears(self) -> bool:
        """True if the box's protocol has a device clear, and accepts tables in blocks."""
        return self._protocol != _FIRST_PROTOCOL

    def _set_up(self) -> int:
        settings = self._settings
        commands = [
            f"TRIG:OUTP:WIDT {settings.edge_width_us}",
            f":TRIG:OUTP:POL {'NORM' if settings.edge_polarity == 'normal' else 'INV'}",
            f":TRIG:READ:SOUR {'INP' if settings.wait_for_ready else 'NONE'}",
            f":SYST:WATC {settings.watchdog_s:g}",
            ":SYST:LEDS?",
        ]
        (count,) = self._scpi.ask(";".join(commands), 1)
        if int(self._scpi.number(count)) != settings.led_count:
            self._refuse(
                f"{settings.led_count} LEDs",
                f"the box has {count!r}",
                "Set led_count in the rig, or connect the right box.",
            )
        return settings.led_count

    # Tables and log.

    def _start(self, payload: bytes, table: NDArray[np.void]) -> None:
        if payload not in self._banks:
            self._refuse("a loaded table", "neither bank holds this table", "Call load() first.")
        bank = self._banks.index(payload)
        if self._crc(bank) != zlib.crc32(payload):
            self._upload(bank, payload)
            if (bank_crc := self._crc(bank)) != (payload_crc := zlib.crc32(payload)):
                self._banks[bank] = None
                self._refuse(
                    f"CRC-32 {payload_crc} in bank {bank}",
                    f"it is {bank_crc} after two uploads",
                    "Check the cable for interference.",
                )
        self._scpi.ask("INIT", 0)
        self._running_bank, self._next_record = bank, 0
        self._started = table.copy()

    def _upload(self, bank: int, payload: bytes) -> None:
        self._banks[bank] = None
        size = BLOCK_BYTES if self._clears else max(1, len(payload))
        for first in range(0, max(1, len(payload)), size):
            header = f"SEQ:BANK {bank};DATA{':APP' if first else ''} ".encode("ascii")
            self._scpi.ask(header + _block(payload[first : first + size]), 0)
        self._banks[bank], self._last_loaded = payload, bank

    def _payload(self, table: NDArray[np.void]) -> bytes:
        """The bytes to upload."""
        try:
            return pack(table)
        except ValueError as error:
            self._refuse(
                "a table whose figures fit into the records of the box", str(error), "Correct this figure."
            )

    def _crc(self, bank: int) -> int:
        (crc,) = self._scpi.ask(f"SEQ:BANK {bank};CRC?", 1)
        return int(self._scpi.number(crc))

    def _poll(self) -> tuple[bool, NDArray[np.void]]:
        """Return whether there are more records of finished steps to fetch, and the next records."""
        bytes_wanted = self._scpi.bytes_per_s * _POLL_S - _POLL_OVERHEAD_BYTES
        limit = max(1, min(_MAX_RECORDS_PER_POLL, int(bytes_wanted / RECORD_BYTES)))
        command = f"SEQ:STAT?;INDex?;LOG? {self._next_record},{limit}"
        state, index, log = self._scpi.ask(command, 3, reply_bytes=limit * RECORD_BYTES)
        self._note_state(str(state))
        if not isinstance(log, bytes):
            self._scpi.raise_unexpected("a block of log records", repr(log))
        try:
            records = unpack_log(log, self._started)
        except ValueError as error:
            self._scpi.raise_unexpected(f"the log of a table of {len(self._started)} steps", str(error))
        finished_count = int(self._scpi.number(index))
        if finished_count > len(self._started) or self._next_record + len(records) > len(self._started):
            self._scpi.raise_unexpected(f"at most {len(self._started)} records", f"{finished_count} are claimed")
        steps = np.arange(self._next_record, self._next_record + len(records))
        wrong = (records["step"] != steps) | (records["led"] != self._started["led"][steps])
        if wrong.any():
            first = int(np.flatnonzero(wrong)[0])
            self._scpi.raise_unexpected(f"the log's record of step {steps[first]}", f"{records[first]} came")
        self._next_record += len(records)
        return self._next_record < finished_count, records

    def _note_state(self, state: str) -> bool:
        if state not in ("IDLE", "RUN", "ABORTED", "FAULT"):
            self._scpi.raise_unexpected("IDLE, RUN, ABORTED or FAULT", repr(state))
        if state == "FAULT" or (state == "ABORTED" and self._running_bank is not None):
            self._raise_fault(f"the burst ended in state {state}")
        if state != "RUN":
            self._running_bank = None
        return state == "RUN"

    def _raise_fault(self, observation: str) -> NoReturn:
        raise DeviceFault(
            self._settings.name,
            expected="a box without fault",
            happened=observation,
            remedy="Find the cause, then open the box anew: that resets the fault.",
        )

    def _refuse(self, expectation: str, observation: str, remedy: str) -> NoReturn:
        raise DeviceRefused(self._settings.name, expected=expectation, happened=observation, remedy=remedy)


def _block(payload: bytes) -> bytes:
    """`payload` as an IEEE 488.2 definite-length block."""
    length = str(len(payload))
    return f"#{len(length)}{length}".encode("ascii") + payload
