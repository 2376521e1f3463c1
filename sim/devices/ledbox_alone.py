"""The LED box alone: `python -m sim.devices.ledbox_alone [speed]` prints its port and runs until interrupted."""

from __future__ import annotations

import json
import signal
import sys
import tempfile
from pathlib import Path

from sim.devices.ledbox_firmware import LedBoxFirmware, Settings
from sim.world.clock import ClockWriter
from sim.world.reactor import Reactor


def main(speed: float) -> None:
    """Serve one box at `speed` times real time. Nothing receives its light and its edges."""
    with tempfile.TemporaryDirectory() as folder:
        clock_path = Path(folder) / "clock"
        reactor = Reactor(ClockWriter(clock_path, speed))
        box = LedBoxFirmware(reactor, Settings())
        sys.stdout.write(json.dumps({"port": box.port, "clock": str(clock_path)}) + "\n")
        sys.stdout.flush()
        for name in (signal.SIGINT, signal.SIGTERM):
            signal.signal(name, lambda *_: reactor.stop())
        reactor.run()
        box.close()


if __name__ == "__main__":
    main(float(sys.argv[1]) if len(sys.argv) > 1 else 1.0)
