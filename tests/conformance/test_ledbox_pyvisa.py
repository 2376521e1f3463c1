"""The box speaks SCPI to others too: PyVISA with its pure Python back end, no line of Coupole's driver."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyvisa
from ledbox_world import ledbox_world
from pyvisa.resources import SerialInstrument

STEP = np.dtype("<u2, <u2, <u4, <u4, <u4")
"""LED, flags, on, trigger delay and period in us: as docs/reference/ledbox-protocol.md has them."""
RECORD = np.dtype("<u4, <u2, <u2, <u8, <u8, <i2, <u2")
"""Step, LED, status, times of light and edge in ns, tenths of a degree, mA."""


def test_pyvisa_uploads_a_table_starts_it_and_reads_the_log(tmp_path: Path) -> None:
    steps = np.array([(led, 0, 8000, 100, 10_000) for led in range(1, 11)], STEP)  # its bytes hold LF: led 10
    manager = pyvisa.ResourceManager("@py")
    with ledbox_world(tmp_path) as world:
        visa = manager.open_resource(f"ASRL{world.box.port}::INSTR", resource_pyclass=SerialInstrument)
        visa.baud_rate, visa.timeout = 115200, 10_000
        visa.read_termination = visa.write_termination = "\n"

        assert visa.query("*IDN?") == "Coupole,LED control box,SIM-0001,1.0"
        visa.write_binary_values("SEQuence:DATA ", steps.tobytes(), datatype="B")
        assert visa.query("SYSTem:ERRor?") == '0,"No error"'
        visa.write("INITiate")
        while visa.query("SEQuence:STATe?") == "RUN":
            world.clock.sleep(0.02)
        log = visa.query_binary_values("SEQuence:LOG? 0,100", datatype="B", container=bytes)

        visa.close()
    manager.close()
    records = np.frombuffer(log, RECORD)
    assert records["f1"].tolist() == list(range(1, 11))
    assert len(world.edges_ns) == 10
