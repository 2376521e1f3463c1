"""Where LEDs stand, for their power: by a record of the kind `leds`."""

from __future__ import annotations

import hashlib
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
import pytest

from coupole.calibration.leds.workflow import led_csv
from coupole.calibration.light.led_power_tile import calibrated_positions
from coupole.calibration.record import Input, Parameter, Validity, seal_record, write_record
from coupole.errors import InputError
from coupole.plan.led_table import LedTable

TABLE = LedTable(
    np.array([3, 7]),
    np.array([0, 1]),
    np.array([[1.0, 2.0, 1400.0], [-500.0, 0.25, 1200.0]]),
    np.array([[0.0, 0.0, -1.0], [0.6, 0.0, -0.8]]),
    np.array([1800.0, 1700.0]),
)


def record(folder: Path, kind: str) -> Path:
    """A record with the table beside it."""
    content = led_csv(TABLE, "made").encode()
    (folder / "made.csv").write_bytes(content)
    now = datetime(2026, 5, 1, tzinfo=UTC)
    write_record(
        folder / "made.yaml",
        seal_record(
            kind=kind,
            name="made",
            created=now,
            software="test",
            simulated=True,
            validity=Validity(expires=now),
            transforms={},
            parameters=(Parameter(name="x_mm", value=1.0, u=0.1, degrees_of_freedom=9.0, dominated_by="spots"),),
            fixed={},
            covariance=((0.01,),),
            files=(Input(name="made.csv", sha256=hashlib.sha256(content).hexdigest()),),
            noise=(),
            images=(),
            limits=(),
            remarks=(),
            inputs=(Input(name="run/run.json", sha256="0" * 64),),
        ),
    )
    return folder / "made.yaml"


def test_leds_stand_where_their_record_has_them(tmp_path: Path) -> None:
    centres_mm, normals = calibrated_positions(record(tmp_path, "leds")).of(np.array([7, 3]))
    assert np.allclose(centres_mm, TABLE.positions_mm[::-1])
    assert np.allclose(normals, TABLE.normals[::-1])


def test_a_record_of_something_else_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a record of the kind `leds`, found one of `led-power`"):
        calibrated_positions(record(tmp_path, "led-power"))
