"""The whole job of `coupole reflectance` on one run: what the tests of a result's files record, and kill.

python recorded_result.py RUN RECORDS OUT
"""

from __future__ import annotations

import sys
from pathlib import Path

from coupole.reflectance.run_job import RunRequest, reflectance_of


def request_of(run: Path, records: Path) -> RunRequest:
    return RunRequest((run,), calibrations=tuple(sorted(records.glob("*.yaml"))))


if __name__ == "__main__":
    reflectance_of(request_of(Path(sys.argv[1]), Path(sys.argv[2])), Path(sys.argv[3]))
