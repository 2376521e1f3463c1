"""The contract of LED boxes that run tables, in addition to the contract of all boxes."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar, Protocol

import numpy as np
import pytest
from numpy.typing import NDArray

from coupole.devices import NO_LED, STEP_DTYPE, LedBox, TableLedBox, table_box
from coupole.errors import DeviceLost, DeviceRefused, DeviceTimeout
from coupole.testing.ledbox_conformance import LedBoxWorld


class TableLedBoxWorld(LedBoxWorld, Protocol):
    """A box whose trigger cable is observed, too."""

    @property
    def edges_ns(self) -> list[int]:
        """Times of all trigger edges on the cable to the camera, ns of `clock`."""


class TableLedBoxConformance:
    """The contract `coupole.devices.TableLedBox`, in addition to `LedBoxConformance`.

    `world` is a `TableLedBoxWorld`. Tables have steps of 1 to 100 ms; the box has at least 30 LEDs.
    """

    limits: ClassVar[Sequence[tuple[str, int, str]]] = (("led", 65_534, ""), ("trigger_delay_us", 8001, ""))
    """Name of a field of a step, a value of this field outside the box's limits (in a step of `table()`), and a
    pattern that the text of the refusal matches. Each refusal also names the step's number."""
    words_of_rest: ClassVar[str] = "7"
    """Pattern of the refusal of step 7, which lights the LED of step 6 again; empty if the box allows this."""
    words_of_no_table: ClassVar[str] = "expected"
    """Pattern of the refusal to start a table that was not loaded."""
    words_of_lost_state: ClassVar[str] = "expected"
    """Pattern that the message matches if the box does not say whether it runs."""
    words_of_a_lost_link: ClassVar[str] = "expected"
    """Pattern of the message when the cable was pulled."""

    def test_it_runs_tables(self, box: LedBox) -> None:
        assert table_box(box) is box

    def test_a_burst_lights_each_led_and_sends_each_edge(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        steps = table(20)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        assert [led for led, _, _ in world.lights] == list(range(20))
        assert records["step"].tolist() == list(range(20))
        assert box.edges() == len(world.edges_ns) == 20
        assert (np.isnan(records["led_current_ma"]) | (records["led_current_ma"] > 0)).all()

    def test_edges_follow_their_light_by_the_trigger_delay(
        self, box: TableLedBox, world: TableLedBoxWorld
    ) -> None:
        steps = table(10, delay_us=300)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        logged_us = (records["t_trigger_ns"] - records["t_on_ns"]) / 1e3
        real_us = (np.array(world.edges_ns) - [on for _, on, _ in world.lights]) / 1e3
        assert logged_us == pytest.approx(300, abs=6)
        assert real_us == pytest.approx(300, abs=6)

    def test_dark_steps_light_nothing_but_send_edges(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        steps = dark_table(3)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        assert (records["led"] == NO_LED).all()
        assert (len(world.lights), len(world.edges_ns)) == (0, 3)

    def test_steps_without_trigger_send_no_edge(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        steps = table(3)
        steps["sends_edge"] = False
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        assert not records["edge_sent"].any()
        assert (world.edges_ns, box.edges()) == ([], 0)

    def test_a_burst_drifts_by_less_than_a_thousandth(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        steps = table(_at_most(200, box), on_us=4000, period_us=5000)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        t_on_ns = records["t_on_ns"].astype(np.int64)
        assert t_on_ns - t_on_ns[0] == pytest.approx(np.arange(len(steps)) * 5e6, rel=1e-3, abs=1)
        assert np.diff(world.edges_ns).sum() == pytest.approx((len(steps) - 1) * 5e6, rel=1e-3)

    def test_the_next_table_is_uploaded_while_one_runs(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        first, second = table(_at_most(100, box)), table(30, led=box.led_count - 30)
        box.load(first)
        box.start(first)
        box.load(second)
        assert box.running()
        assert len(run_to_end(box, world)) == len(first)
        box.start(second)
        assert run_to_end(box, world)["led"].tolist() == list(range(box.led_count - 30, box.led_count))

    def test_a_table_that_is_there_already_is_not_sent_again(
        self, box: TableLedBox, world: TableLedBoxWorld
    ) -> None:
        steps = table(box.led_count)
        box.load(steps)
        world.unplug()
        box.load(steps)  # this would raise DeviceLost if the table had to be sent

    def test_a_table_out_of_limits_is_refused_by_record(self, box: TableLedBox) -> None:
        for field, value, words in self.limits:
            steps = table()
            steps[field][5] = value
            with pytest.raises(DeviceRefused, match=f"5.*{words}"):
                box.load(steps)

    def test_an_led_lit_again_too_soon_is_refused(self, box: TableLedBox) -> None:
        steps = table()
        steps["led"][7] = steps["led"][6]
        if self.words_of_rest:
            with pytest.raises(DeviceRefused, match=self.words_of_rest):
                box.load(steps)

    def test_a_table_never_loaded_does_not_start(self, box: TableLedBox) -> None:
        with pytest.raises(DeviceRefused, match=self.words_of_no_table):
            box.start(table())

    def test_a_long_log_comes_whole(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        steps = table(_at_most(150, box), on_us=1000, period_us=2000)
        box.load(steps)
        box.start(steps)
        world.clock.sleep(1.0)
        assert box.poll_log()["step"].tolist() == list(range(len(steps)))

    def test_lights_off_ends_a_burst_at_once(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        steps = table(_at_most(100, box), on_us=90_000, period_us=100_000)
        box.load(steps)
        box.start(steps)
        world.clock.sleep(0.55)
        box.lights_off()
        assert not box.running()
        lit = len(world.lights)
        world.clock.sleep(0.5)
        assert len(world.lights) == lit < len(steps)

    def test_after_lights_off_another_burst_runs(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        steps = table(_at_most(100, box))
        box.load(steps)
        box.start(steps)
        box.lights_off()
        box.start(steps)
        assert len(run_to_end(box, world)) == len(steps)

    def test_a_mute_box_times_out(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        world.mute()
        with pytest.raises(DeviceTimeout, match=self.words_of_lost_state):
            box.running()

    def test_an_upload_to_a_mute_box_times_out(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        world.mute()
        with pytest.raises(DeviceTimeout):
            box.load(table(box.led_count))

    def test_a_cable_pulled_is_a_device_lost(self, box: TableLedBox, world: TableLedBoxWorld) -> None:
        world.unplug()
        with pytest.raises(DeviceLost, match=self.words_of_a_lost_link):
            box.running()


def table(
    count: int = 12, *, led: int = 0, on_us: int = 8000, delay_us: int = 100, period_us: int = 10_000
) -> NDArray[np.void]:
    """Return `count` lit steps of different LEDs, beginning with `led`."""
    steps = np.zeros(count, STEP_DTYPE)
    steps["led"] = led + np.arange(count)
    steps["on_us"], steps["trigger_delay_us"], steps["period_us"] = on_us, delay_us, period_us
    steps["sends_edge"] = True
    return steps


def dark_table(count: int = 4) -> NDArray[np.void]:
    """Return `count` steps without light, with trigger edges."""
    steps = table(count)
    steps["led"], steps["on_us"] = NO_LED, 0
    return steps


def _at_most(count: int, box: LedBox) -> int:
    """Return `count`, or the number of the box's LEDs if that is smaller."""
    return min(count, box.led_count)


def run_to_end(driver: TableLedBox, world: TableLedBoxWorld, wait_s: float = 30.0) -> NDArray[np.void]:
    """Poll until the burst has ended; return all records of the log."""
    end_ns = world.clock.now_ns() + int(wait_s * 1e9)
    parts = [driver.poll_log()]
    while driver.running():
        parts.append(driver.poll_log())
        assert world.clock.now_ns() < end_ns
        world.clock.sleep(0.03)
    parts.append(driver.poll_log())
    return np.concatenate(parts)
