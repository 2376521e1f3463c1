"""A button that moves an axis while it is held: how long a hold lasts without a renewal, on two clocks."""

from __future__ import annotations

import pytest

from coupole.acquisition.cell_bench import bench_arm
from coupole.acquisition.cell_bench.bench_arm import HoldLostError
from coupole.acquisition.cell_bench.bench_requests import JogAsked
from coupole.clock import SystemClock

HERE = "127.0.0.1"


class ClockByHand(SystemClock):
    """The rig's clock and, for `bench_arm.time`, the machine's: both go on only when they are told to."""

    def __init__(self) -> None:
        self.rig_s = self.machine_s = 0.0

    def now_ns(self) -> int:
        return round(self.rig_s * 1e9)

    def monotonic(self) -> float:
        return self.machine_s


@pytest.fixture
def held(monkeypatch: pytest.MonkeyPatch) -> tuple[bench_arm._Hold, ClockByHand]:
    """A button that is held, and its clock."""
    clock = ClockByHand()
    monkeypatch.setattr(bench_arm, "time", clock)
    asked = JogAsked.model_validate({"version": 1, "command": "jog", "axis": "A1", "direction": 1, "from": HERE})
    return bench_arm._Hold(1, asked, 0, clock), clock


def test_a_renewal_that_comes_late_revives_no_hold(held: tuple[bench_arm._Hold, ClockByHand]) -> None:
    """As after a freeze of the bench, when the renewal is read before the watch looks at the time."""
    hold, clock = held
    clock.rig_s = clock.machine_s = 0.99 * bench_arm.HOLD_S
    hold.check()
    hold.renew()
    clock.rig_s = clock.machine_s = 2.0 * bench_arm.HOLD_S
    hold.renew()
    with pytest.raises(HoldLostError, match="it was not renewed for 300 ms"):
        hold.check()


@pytest.mark.parametrize("other", ["rig_s", "machine_s"])
def test_in_a_slow_or_a_fast_world_a_hold_has_its_time_on_both_clocks(
    held: tuple[bench_arm._Hold, ClockByHand], other: str
) -> None:
    hold, clock = held
    clock.rig_s = clock.machine_s = 10.0 * bench_arm.HOLD_S
    setattr(clock, other, 0.9 * bench_arm.HOLD_S)
    hold.check()
    setattr(clock, other, 1.1 * bench_arm.HOLD_S)
    with pytest.raises(HoldLostError):
        hold.check()
