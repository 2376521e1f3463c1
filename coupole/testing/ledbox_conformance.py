"""The contract of LED boxes as one class, which tests each driver against a simulated box at the other end of its
wire."""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import AbstractContextManager
from typing import Any, ClassVar, Protocol

import pytest

from coupole.clock import Clock
from coupole.devices import NO_LED, LedBox
from coupole.errors import DeviceError, DeviceLost, DeviceRefused, DeviceTimeout
from coupole.testing.waiting import Call, wait_until

FLASH_US = 200_000
"""Duration of a flash, long enough that it can be observed from outside while the world runs at eight times real
speed on a busy machine."""


class LedBoxWorld(Protocol):
    """An LED box as it is seen from outside: the other end of the driver's wire, and its light.

    `sim.world.ledbox_alone.LedBoxAlone` implements this for a stand-in on the event loop of the simulated cell.
    """

    @property
    def clock(self) -> Clock:
        """The clock of both driver and box."""

    @property
    def opener(self) -> Callable[..., AbstractContextManager[Any]]:
        """Function that opens the driver on the box; the driver is closed when the context ends."""

    @property
    def lights(self) -> list[tuple[int, int, int]]:
        """All lights that have begun, the oldest first: LED, begin, and the end if nothing ends it before (ns)."""

    @property
    def panels(self) -> list[tuple[int, bool]]:
        """Every switching of a panel, the oldest first: number of the panel, and True if it was switched on."""

    def shining(self) -> list[int]:
        """LEDs that shine now."""

    def wait_until_dark(self) -> None:
        """Wait until nothing shines; fail if something does not go out."""

    def lit_us(self, number: int) -> float:
        """Return how long light number `number` (from 0, in `lights`) has shone until now, us."""

    def kill_led(self, led: int) -> None:
        """Make an LED dead from its next flash on; the box cannot notice it."""

    def mute(self, seconds: float | None = None) -> None:
        """Make the box neither receive nor answer, for `seconds` of `clock` or for ever. A lit LED stays lit until
        its time ends."""

    def unplug(self) -> None:
        """Pull the cable between host and box. A lit LED stays lit until its time ends."""

    def lose_answers(self, count: int) -> list[bytes]:
        """Lose the box's next `count` answers; return the list in which they are collected."""

    def slow_down(self) -> None:
        """From now on, make the driver's time-outs longer than any delay of the machine. This has no effect if
        `clock` is the machine's clock."""


class LedBoxConformance:
    """The contract `coupole.devices.LedBox`.

    A subclass gives two fixtures: `world`, a `LedBoxWorld`, and `box`, the driver that its `opener` has opened.
    The box has at least eight LEDs.
    """

    long_us: ClassVar[int] = 2_000_000
    """Longest light that the box allows, us; a flash of this duration does not end during a test."""
    most_on_us: ClassVar[float] = 1.7 * FLASH_US
    """Upper limit, us, of the on-time in the record of a flash of `FLASH_US` that ended by itself and is read one
    `FLASH_US` later."""
    is_simulated: ClassVar[bool] = True
    """Expected value of `Identity.simulated`. The light of stand-ins is not entered in the ledger of real
    objects."""
    words_of_silence: ClassVar[str] = "expected"
    """Pattern of the message about a box that does not answer."""
    words_of_a_lost_link: ClassVar[str] = "expected"
    """Pattern of the message about a cable that was pulled."""

    def test_it_says_who_it_is_and_whether_it_is_a_stand_in(self, box: LedBox) -> None:
        identity = box.identify()
        assert all((identity.vendor, identity.model, identity.serial, identity.firmware))
        assert identity.simulated is self.is_simulated

    def test_its_self_test_passes_in_the_dark(self, box: LedBox, world: LedBoxWorld) -> None:
        assert box.self_test()
        assert world.lights == []

    def test_its_class_says_what_it_can_do(self, box: LedBox) -> None:
        assert type(box).runs_tables in (True, False)
        assert type(box).panel_count >= 0

    @pytest.mark.parametrize("place", ["first", "second", "last"])
    def test_a_flash_lights_the_led_that_was_asked_for_and_no_other(
        self, box: LedBox, world: LedBoxWorld, place: str
    ) -> None:
        led = {"first": 0, "second": 1, "last": box.led_count - 1}[place]
        box.flash(led, self.long_us)
        lit_leds = world.shining()
        assert box.lit()
        assert lit_leds == [led]

    def test_a_flash_ends_dark_and_says_what_it_was(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, FLASH_US)
        record = box.end_flash()
        assert world.shining() == []
        assert not box.lit()
        assert (record.step, record.led, record.edge_sent) == (0, 5, False)
        assert record.on_us >= world.lit_us(0) * 0.999  # the clocks of box and world differ slightly
        assert not record.invalid_exposure

    def test_a_flash_that_nobody_ends_goes_out_by_itself(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, FLASH_US)
        world.wait_until_dark()
        assert not box.lit()
        assert box.end_flash().led == 5

    def test_a_flash_lasts_as_long_as_was_asked_if_it_is_let(self, box: LedBox, world: LedBoxWorld) -> None:
        begun_ns = world.clock.now_ns()
        box.flash(5, FLASH_US)
        world.wait_until_dark()
        dark_ns = world.clock.now_ns()
        assert world.lit_us(0) >= FLASH_US * 0.999
        world.clock.sleep(FLASH_US * 1e-6)
        on_us = box.end_flash().on_us
        assert on_us >= world.lit_us(0) * 0.999
        late_us = (dark_ns - begun_ns) / 1e3 - FLASH_US  # delay of a busy machine
        assert on_us <= self.most_on_us + max(0.0, late_us), "a light that the box has ended does not go on"

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
        world.kill_led(4)
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

    def test_after_an_acknowledgement_all_is_dark(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, self.long_us)
        box.acknowledge()
        assert world.shining() == []
        assert not box.lit()

    def test_lights_off_from_another_thread_waits_for_no_call(self, box: LedBox, world: LedBoxWorld) -> None:
        world.slow_down()
        box.flash(5, self.long_us)
        lost_answers = world.lose_answers(1)
        call = Call(lambda: box.flash(6, self.long_us))
        wait_until(lambda: bool(lost_answers), "a call that waits for its answer")
        box.lights_off()
        assert world.shining() == []
        error = call.wait()
        assert isinstance(error, DeviceError), error
        assert not isinstance(error, DeviceTimeout)  # it must not have waited for its own time-out
        assert world.shining() == []
        box.flash(7, self.long_us)
        wait_until(lambda: world.shining() == [7], "the next flash")

    def test_a_call_that_lights_off_overtakes_lights_nothing(self, box: LedBox, world: LedBoxWorld) -> None:
        """The call waits for its turn while another call is answered. If `lights_off` comes before its turn, it
        must not light any more."""
        world.slow_down()
        lost_answers = world.lose_answers(1)
        first = Call(lambda: box.flash(5, self.long_us))
        wait_until(lambda: bool(lost_answers), "a call that waits for its answer")
        second = Call(lambda: box.flash(6, self.long_us))
        wait_until(second.waits_its_turn, "a second call behind it")
        box.lights_off()
        assert isinstance(first.wait(), DeviceError)
        assert isinstance(second.wait(), DeviceError)
        assert world.shining() == []
        assert 6 not in [led for led, _, _ in world.lights]

    def test_lights_off_of_two_threads_at_once_is_confirmed_to_both(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, self.long_us)
        calls = [Call(box.lights_off) for _ in range(3)]
        assert [call.wait() for call in calls] == [None, None, None]
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
        switchings = [(panel, on) for panel in range(1, box.panel_count + 1) for on in (True, False)]
        assert world.panels == switchings

    def test_each_of_its_panels_can_be_switched_off_alone(self, box: LedBox, world: LedBoxWorld) -> None:
        for panel in range(1, box.panel_count + 1):
            box.panel(panel, on=True)
            box.panel(panel, on=False)
            assert world.panels[-2:] == [(panel, True), (panel, False)]

    def test_a_flash_of_a_mute_box_times_out(self, box: LedBox, world: LedBoxWorld) -> None:
        world.mute()
        with pytest.raises(DeviceTimeout, match=self.words_of_silence):
            box.flash(5, FLASH_US)

    def test_a_box_that_was_mute_for_a_while_missed_what_came_and_obeys_again(
        self, box: LedBox, world: LedBoxWorld
    ) -> None:
        world.mute(3.0)
        with pytest.raises(DeviceTimeout):
            box.flash(4, FLASH_US)
        world.clock.sleep(3.0)
        box.lights_off()
        box.flash(5, FLASH_US)
        box.end_flash()
        assert [led for led, _, _ in world.lights] == [5]

    def test_a_box_that_falls_mute_in_a_flash_is_not_believed(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, self.long_us)
        world.mute()
        with pytest.raises(DeviceTimeout):
            box.end_flash()

    def test_lights_off_of_a_mute_box_is_bounded(self, box: LedBox, world: LedBoxWorld) -> None:
        world.mute()
        start_ns = world.clock.now_ns()
        with pytest.raises(DeviceTimeout):
            box.lights_off()
        assert world.clock.now_ns() - start_ns < 30e9

    def test_a_cable_pulled_is_a_device_lost(self, box: LedBox, world: LedBoxWorld) -> None:
        world.unplug()
        with pytest.raises(DeviceLost, match=self.words_of_a_lost_link):
            box.flash(5, FLASH_US)

    def test_a_cable_pulled_in_a_flash_is_a_device_lost(self, box: LedBox, world: LedBoxWorld) -> None:
        box.flash(5, self.long_us)
        world.unplug()
        with pytest.raises(DeviceLost):
            box.end_flash()

    def test_closing_a_box_that_is_gone_raises_nothing(self, box: LedBox, world: LedBoxWorld) -> None:
        world.unplug()
        box.close()

    def test_a_box_that_is_gone_cannot_be_opened(self, world: LedBoxWorld) -> None:
        world.unplug()
        with pytest.raises(DeviceError), world.opener():
            pass
