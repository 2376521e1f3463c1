"""What every LED box must do, and what those must do that run tables: one class each, run on each driver against
the other end of its wire."""

from __future__ import annotations

import math

import numpy as np
import pytest
from ledbox_world import Call, LedBoxWorld, dark_table, run_to_end, table, wait_until

from coupole.devices import NO_LED, LedBox, TableLedBox, table_box
from coupole.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout

FLASH_US = 200_000
"""Long enough to be looked at from outside, in a world of eight times real speed on a busy machine."""


class LedBoxConformance:
    """The contract `coupole.devices.LedBox`."""

    long_us = 2_000_000
    """As long as the box allows: no test may outlast it."""

    def test_it_says_who_it_is_and_that_it_is_a_stand_in(self, box: LedBox) -> None:
        identity = box.identify()
        assert identity.vendor == "Coupole"
        assert identity.serial.startswith("SIM-")
        assert identity.simulated

    def test_its_self_test_passes_in_the_dark(self, box: LedBox, world: LedBoxWorld) -> None:
        assert box.self_test()
        assert world.lights == []

    def test_its_class_says_what_it_can_do(self, box: LedBox) -> None:
        assert type(box).runs_tables in (True, False)
        assert type(box).panel_count >= 0

    @pytest.mark.parametrize("which", ["first", "second", "last"])
    def test_a_flash_lights_the_led_that_was_asked_for_and_no_other(
        self, box: LedBox, world: LedBoxWorld, which: str
    ) -> None:
        led = {"first": 0, "second": 1, "last": box.led_count - 1}[which]
        box.flash(led, self.long_us)
        seen = world.shining()
        assert box.lit()
        assert seen == [led]

    def test_a_flash_ends_dark_and_says_what_it_was(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, FLASH_US)
        record = box.end_flash()
        assert world.shining() == []
        assert not box.lit()
        assert (record.step, record.led, record.edge_sent) == (0, 5, False)
        assert record.on_us >= world.lit_us(0) * 0.999  # the box's quartz and the world's clock differ a little
        assert not record.invalid_exposure

    def test_a_flash_that_nobody_ends_goes_out_by_itself(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, FLASH_US)
        world.wait_until_dark()
        assert not box.lit()
        assert box.end_flash().led == 5

    def test_a_flash_lasts_as_long_as_was_asked_if_it_is_let(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, FLASH_US)
        world.wait_until_dark()
        assert world.lit_us(0) >= FLASH_US * 0.999

    def test_a_flash_without_light_is_dark_all_through(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(NO_LED, self.long_us)
        assert box.lit()
        record = box.end_flash()
        assert (record.led, record.on_us) == (NO_LED, 0)
        assert world.lights == []
        assert not box.lit()

    def test_flashes_follow_each_other_and_never_overlap(self, box: LedBox, world: LedBoxWorld) -> None:
        for led in (3, 1, 2, 2):
            box.flash(led, FLASH_US)
            assert box.end_flash().led == led
            assert world.shining() == []
        assert [led for led, _, _ in world.lights] == [3, 1, 2, 2]

    def test_nothing_is_lit_before_the_first_flash(self, box: LedBox) -> None:
        assert not box.lit()

    def test_an_led_that_it_does_not_have_is_refused_in_the_dark(self, box: LedBox, world: LedBoxWorld) -> None:
        for led in (box.led_count, -2):
            with pytest.raises(DeviceRefused):
                box.flash(led, FLASH_US)
        assert world.lights == []

    def test_a_dead_led_gives_no_light(self, box: LedBox, world: LedBoxWorld) -> None:
        world.do(lambda: world.box.dead_leds.add(4))
        box.flash(4, FLASH_US)
        box.end_flash()
        assert world.lights == []

    def test_what_the_box_cannot_know_is_said_to_be_unknown(self, box: LedBox) -> None:
        box.flash(5, FLASH_US)
        record = box.end_flash()
        celsius = box.board_temperature_c(0)
        assert math.isnan(record.board_temperature_c) == (celsius is None)
        assert celsius is None or 0 < celsius < 100

    def test_lights_off_ends_a_flash_at_once(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, self.long_us)
        box.lights_off()
        assert world.shining() == []
        assert not box.lit()

    def test_lights_off_from_another_thread_waits_for_no_call(self, box: LedBox, world: LedBoxWorld) -> None:
        world.slow_down()
        box.flash(5, self.long_us)
        lost = world.lose_answers(1)
        call = Call(lambda: box.flash(6, self.long_us))
        wait_until(lambda: bool(lost), "a call that waits for its answer")
        box.lights_off()
        assert world.shining() == []
        error = call.ended()
        assert isinstance(error, DeviceError), error
        assert not isinstance(error, DeviceTimeout)  # its own time-out is what it would have waited for
        assert world.shining() == []
        box.flash(7, self.long_us)
        wait_until(lambda: world.shining() == [7], "the next flash")

    def test_a_call_that_lights_off_overtakes_lights_nothing(self, box: LedBox, world: LedBoxWorld) -> None:
        """It waits for its turn while another call is answered; then it is too late for it."""
        world.slow_down()
        lost = world.lose_answers(1)
        first = Call(lambda: box.flash(5, self.long_us))
        wait_until(lambda: bool(lost), "a call that waits for its answer")
        second = Call(lambda: box.flash(6, self.long_us))
        wait_until(second.waits_for_a_lock, "a second call behind it")
        box.lights_off()
        assert isinstance(first.ended(), DeviceError)
        assert isinstance(second.ended(), DeviceError)
        assert world.shining() == []
        assert 6 not in [led for led, _, _ in world.lights]

    def test_lights_off_of_two_threads_at_once_is_confirmed_to_both(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, self.long_us)
        calls = [Call(box.lights_off) for _ in range(3)]
        assert [call.ended() for call in calls] == [None, None, None]
        assert world.shining() == []

    def test_lights_off_in_the_dark_does_no_harm(self, box: LedBox, world: LedBoxWorld) -> None:
        box.lights_off()
        box.lights_off()
        box.flash(5, FLASH_US)
        assert box.end_flash().led == 5
        assert [led for led, _, _ in world.lights] == [5]

    def test_closing_leaves_no_light(self, world: LedBoxWorld) -> None:
        with world.opener() as box:
            box.flash(5, self.long_us)
        assert [led for led, _, _ in world.lights] == [5]
        assert world.shining() == []

    def test_an_exception_of_the_caller_leaves_no_light(self, world: LedBoxWorld) -> None:
        def fail() -> None:
            with world.opener() as box:
                box.flash(5, self.long_us)
                raise ZeroDivisionError

        with pytest.raises(ZeroDivisionError):
            fail()
        assert [led for led, _, _ in world.lights] == [5]
        assert world.shining() == []

    def test_closing_twice_does_no_harm(self, box: LedBox) -> None:
        box.close()
        box.close()

    def test_a_panel_that_it_does_not_have_is_refused(self, box: LedBox) -> None:
        with pytest.raises(DeviceRefused):
            box.panel(box.panel_count + 1, on=True)

    def test_each_of_its_panels_shines_until_lights_off(self, box: LedBox, world: LedBoxWorld) -> None:
        for panel in range(1, box.panel_count + 1):
            box.panel(panel, on=True)
            box.lights_off()
        expected = [(panel, on) for panel in range(1, box.panel_count + 1) for on in (True, False)]
        assert world.panels == expected

    def test_a_flash_of_a_mute_box_times_out(self, box: LedBox, world: LedBoxWorld) -> None:
        world.do(world.box.mute)
        with pytest.raises(DeviceTimeout, match="led box: expected an answer to"):
            box.flash(5, FLASH_US)

    def test_a_box_that_was_mute_for_a_while_missed_what_came_and_obeys_again(
        self, box: LedBox, world: LedBoxWorld
    ) -> None:
        world.do(lambda: world.box.mute(3.0))
        with pytest.raises(DeviceTimeout):
            box.flash(4, FLASH_US)
        world.clock.sleep(3.0)
        box.lights_off()
        box.flash(5, FLASH_US)
        box.end_flash()
        assert [led for led, _, _ in world.lights] == [5]

    def test_a_box_that_falls_mute_in_a_flash_is_not_believed(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, self.long_us)
        world.do(world.box.mute)
        with pytest.raises(DeviceTimeout):
            box.end_flash()

    def test_lights_off_of_a_mute_box_is_bounded(self, box: LedBox, world: LedBoxWorld) -> None:
        world.do(world.box.mute)
        start_ns = world.clock.now_ns()
        with pytest.raises(DeviceTimeout):
            box.lights_off()
        assert world.clock.now_ns() - start_ns < 30e9

    def test_a_cable_pulled_is_a_device_lost(self, box: LedBox, world: LedBoxWorld) -> None:
        world.do(world.box.unplug)
        with pytest.raises(DeviceLost, match="Check the cable"):
            box.flash(5, FLASH_US)

    def test_a_cable_pulled_in_a_flash_is_a_device_lost(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, self.long_us)
        world.do(world.box.unplug)
        with pytest.raises(DeviceLost):
            box.end_flash()

    def test_closing_a_box_that_is_gone_raises_nothing(self, box: LedBox, world: LedBoxWorld) -> None:
        world.do(world.box.unplug)
        box.close()

    def test_a_box_that_is_gone_cannot_be_opened(self, world: LedBoxWorld) -> None:
        world.do(world.box.unplug)
        with pytest.raises(DeviceError), world.opener():
            pass


class TableLedBoxConformance:
    """The contract `coupole.devices.TableLedBox`."""

    def test_it_runs_tables(self, box: LedBox) -> None:
        assert table_box(box) is box

    def test_a_burst_lights_each_led_and_sends_each_edge(self, box: TableLedBox, world: LedBoxWorld) -> None:
        steps = table(20)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        assert [led for led, _, _ in world.lights] == list(range(20))
        assert records["step"].tolist() == list(range(20))
        assert box.edges() == len(world.edges_ns) == 20
        assert (records["led_current_ma"] == 700).all()

    def test_edges_follow_their_light_by_the_trigger_delay(self, box: TableLedBox, world: LedBoxWorld) -> None:
        steps = table(10, delay_us=300)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        logged_us = (records["t_trigger_ns"] - records["t_on_ns"]) / 1e3
        real_us = (np.array(world.edges_ns) - [on for _, on, _ in world.lights]) / 1e3
        assert logged_us == pytest.approx(300, abs=6)
        assert real_us == pytest.approx(300, abs=6)

    def test_dark_steps_light_nothing_but_send_edges(self, box: TableLedBox, world: LedBoxWorld) -> None:
        steps = dark_table(3)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        assert (records["led"] == NO_LED).all()
        assert (len(world.lights), len(world.edges_ns)) == (0, 3)

    def test_steps_without_trigger_send_no_edge(self, box: TableLedBox, world: LedBoxWorld) -> None:
        steps = table(3)
        steps["sends_edge"] = False
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        assert not records["edge_sent"].any()
        assert (world.edges_ns, box.edges()) == ([], 0)

    def test_a_burst_drifts_by_less_than_a_thousandth(self, box: TableLedBox, world: LedBoxWorld) -> None:
        steps = table(200, on_us=4000, period_us=5000)
        box.load(steps)
        box.start(steps)
        records = run_to_end(box, world)
        t_on_ns = records["t_on_ns"].astype(np.int64)
        assert t_on_ns - t_on_ns[0] == pytest.approx(np.arange(200) * 5e6, rel=1e-3, abs=1)
        assert np.diff(world.edges_ns).sum() == pytest.approx(199 * 5e6, rel=1e-3)

    def test_the_next_table_is_uploaded_while_one_runs(self, box: TableLedBox, world: LedBoxWorld) -> None:
        first, second = table(100), table(30, led=500)
        box.load(first)
        box.start(first)
        box.load(second)
        assert box.running()
        assert len(run_to_end(box, world)) == 100
        box.start(second)
        assert run_to_end(box, world)["led"].tolist() == list(range(500, 530))

    def test_a_table_that_is_there_already_is_not_sent_again(self, box: TableLedBox, world: LedBoxWorld) -> None:
        steps = table(1080)
        box.load(steps)
        world.do(world.box.unplug)
        box.load(steps)  # would raise DeviceLost if it had to be sent

    @pytest.mark.parametrize(
        ("field", "value", "words"),
        [
            ("led", 1080, "led must be below 1080"),
            ("on_us", 999, "on_us must be 1000 to 2000000"),
            ("trigger_delay_us", 8001, "trigger_delay_us must not exceed on_us"),
            ("period_us", 7999, "period_us must cover"),
        ],
    )
    def test_a_table_out_of_limits_is_refused_by_record(
        self, box: TableLedBox, field: str, value: int, words: str
    ) -> None:
        steps = table()
        steps[field][5] = value
        with pytest.raises(DeviceRefused, match=f"-222.*record 5: {words}"):
            box.load(steps)

    def test_an_led_lit_again_too_soon_is_refused(self, box: TableLedBox) -> None:
        steps = table()
        steps["led"][7] = steps["led"][6]
        with pytest.raises(DeviceRefused, match="record 7: led 6 rests 2000 us after record 6, 16000 us"):
            box.load(steps)

    def test_a_table_never_loaded_does_not_start(self, box: TableLedBox) -> None:
        with pytest.raises(DeviceRefused, match="neither bank"):
            box.start(table())

    def test_a_long_log_comes_whole(self, box: TableLedBox, world: LedBoxWorld) -> None:
        steps = table(150, on_us=1000, period_us=2000)
        box.load(steps)
        box.start(steps)
        world.clock.sleep(1.0)
        assert box.poll_log()["step"].tolist() == list(range(150))

    def test_lights_off_ends_a_burst_at_once(self, box: TableLedBox, world: LedBoxWorld) -> None:
        steps = table(100, on_us=90_000, period_us=100_000)
        box.load(steps)
        box.start(steps)
        world.clock.sleep(0.55)
        box.lights_off()
        assert not box.running()
        lit = len(world.lights)
        world.clock.sleep(0.5)
        assert len(world.lights) == lit < 100

    def test_after_lights_off_another_burst_runs(self, box: TableLedBox, world: LedBoxWorld) -> None:
        steps = table(100)
        box.load(steps)
        box.start(steps)
        box.lights_off()
        box.start(steps)
        assert len(run_to_end(box, world)) == 100

    def test_panels_shine_until_lights_off(self, box: TableLedBox, world: LedBoxWorld) -> None:
        box.panel(3, on=True)
        box.lights_off()
        assert world.panels == [(3, True), (3, False)]

    def test_a_mute_box_times_out(self, box: TableLedBox, world: LedBoxWorld) -> None:
        world.do(world.box.mute)
        with pytest.raises(DeviceTimeout, match="led box: expected an answer to SEQ:STAT"):
            box.running()

    def test_lights_off_of_a_mute_box_is_bounded(self, box: TableLedBox, world: LedBoxWorld) -> None:
        world.do(world.box.mute)
        start_ns = world.clock.now_ns()
        with pytest.raises(DeviceTimeout):
            box.lights_off()
        assert world.clock.now_ns() - start_ns < 30e9

    def test_an_upload_to_a_mute_box_times_out(self, box: TableLedBox, world: LedBoxWorld) -> None:
        world.do(world.box.mute)
        with pytest.raises(DeviceTimeout):
            box.load(table(1080))

    def test_a_cable_pulled_is_a_device_lost(self, box: TableLedBox, world: LedBoxWorld) -> None:
        world.do(world.box.unplug)
        with pytest.raises(DeviceLost, match="Check the cable"):
            box.running()
