"""The LED box of text lines: what every box must do, in several dialects, and what goes wrong with lines."""

from __future__ import annotations

import os
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from ledbox_world import text_world
from pydantic import ValidationError

from coupole.devices import table_box
from coupole.errors import DeviceLost, DeviceRefused, DeviceTimeout
from coupole.testing import LedBoxConformance
from coupole.testing.ledbox_conformance import FLASH_US
from coupole.testing.waiting import wait_until
from drivers.ledbox.text_lines import Settings, TextLineBox, read_reply
from sim.world.ledbox_alone import LedBoxAlone

LONG_US = 20_000_000
DIALECTS: dict[str, dict[str, Any]] = {
    "plain": {},
    "counts-from-1": {"driver": {"first_led": 1}, "first_led": 1},
    "ends-light-itself": {"driver": {"on": "LED {led:03d} ON {on_ms}", "line_ending": "crlf"}},
    "all-off-only": {"driver": {"off": None}},
}


@pytest.fixture(params=sorted(DIALECTS))
def world(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[LedBoxAlone]:
    with text_world(tmp_path, **DIALECTS[request.param]) as running:
        yield running


@pytest.fixture
def box(world: LedBoxAlone) -> Iterator[TextLineBox]:
    with world.opener() as driver:
        yield driver


@pytest.fixture
def plain(tmp_path: Path) -> Iterator[LedBoxAlone]:
    """A world with the plain dialect alone."""
    with text_world(tmp_path) as running:
        yield running


def say(world: LedBoxAlone, words: bytes) -> None:
    """The box says something that nobody asked for."""
    world.do(lambda: world.box._link.send(words))
    world.clock.sleep(0.2)


class TestTextLineBox(LedBoxConformance):
    """The contract, in each dialect."""

    long_us = LONG_US
    words_of_silence = "led box: expected an answer to"
    words_of_a_lost_link = "Check the cable"

    def test_it_tells_vendor_and_serial_number(self, box: TextLineBox) -> None:
        identity = box.identify()
        assert (identity.vendor, identity.serial) == ("Coupole", "SIM-0002")

    def test_it_runs_no_tables_and_says_what_to_do(self, box: TextLineBox) -> None:
        with pytest.raises(DeviceRefused, match="Set `trigger: software` in the plan"):
            table_box(box)

    def test_opening_ends_what_a_host_left_alight_that_was_killed(self, world: LedBoxAlone) -> None:
        port = os.open(world.box.port, os.O_WRONLY | os.O_NOCTTY)
        number = b"6" if world.box._settings.first_led else b"5"
        os.write(port, b"LED " + number + b" ON\n")
        os.close(port)
        world.clock.sleep(0.3)
        assert world.shining() == [5]
        with world.opener():
            assert world.shining() == []

    def test_half_a_line_of_a_host_that_was_killed_does_no_harm(self, world: LedBoxAlone) -> None:
        port = os.open(world.box.port, os.O_WRONLY | os.O_NOCTTY)
        os.write(port, b"LED 5 O")
        os.close(port)
        with world.opener() as box:
            box.flash(7, LONG_US)
            assert world.shining() == [7]

    def test_a_box_with_fewer_leds_than_the_rig_says_is_quoted(self, world: LedBoxAlone) -> None:
        with (
            world.opener(led_count=1000) as box,
            pytest.raises(DeviceRefused, match=r"it said `ERR no LED 0?90[01]`"),
        ):
            box.flash(900, FLASH_US)
        assert world.lights == []


def test_a_flash_refused_by_the_box_ends_what_shone_before(plain: LedBoxAlone) -> None:
    with plain.opener(led_count=1000) as box:
        box.flash(5, LONG_US)
        with pytest.raises(DeviceRefused, match="ERR no LED 900"):
            box.flash(900, FLASH_US)
        assert plain.shining() == []


def test_an_led_beyond_the_rigs_count_is_refused_though_the_box_has_it(plain: LedBoxAlone) -> None:
    with (
        plain.opener(led_count=8) as box,
        pytest.raises(DeviceRefused, match="an LED from 0 to 7; 8 was asked for"),
    ):
        box.flash(8, FLASH_US)
    assert plain.lights == []


def test_a_second_flash_ends_the_first(plain: LedBoxAlone) -> None:
    with plain.opener() as box:
        box.flash(5, LONG_US)
        box.flash(7, LONG_US)
        assert plain.shining() == [7]


def test_a_light_that_was_not_confirmed_is_ended(plain: LedBoxAlone) -> None:
    with plain.opener() as box:
        silent = plain.box._settings.model_copy(update={"answers": False})
        plain.do(lambda: setattr(plain.box, "_settings", silent))  # it obeys, but its answers are lost
        with pytest.raises(DeviceTimeout):
            box.flash(5, LONG_US)
        assert [led for led, _, _ in plain.lights] == [5]
        plain.wait_until_dark()


def test_a_box_that_refuses_to_end_a_light_is_quoted_and_all_is_switched_off(plain: LedBoxAlone) -> None:
    with plain.opener(off="DARK {led}") as box:
        box.flash(5, LONG_US)
        with pytest.raises(DeviceRefused, match=r"it said `ERR what\? DARK 5`"):
            box.end_flash()
        assert plain.shining() == []


def test_the_same_is_said_where_the_drivers_own_thread_ended_it(plain: LedBoxAlone) -> None:
    with plain.opener(off="DARK {led}") as box:
        box.flash(5, FLASH_US)
        plain.wait_until_dark()
        with pytest.raises(DeviceRefused, match=r"it said `ERR what\? DARK 5`"):
            box.end_flash()


def test_a_box_that_confirms_with_other_words_is_refused_and_dark(plain: LedBoxAlone) -> None:
    with (
        pytest.raises(DeviceRefused, match="expected `ready` in answer to `ALL OFF`; it said `OK`"),
        plain.opener(expected_reply="ready"),
    ):
        pass
    assert plain.shining() == []


def test_the_light_goes_out_though_the_caller_hangs_and_the_box_knows_no_time(plain: LedBoxAlone) -> None:
    with plain.opener() as box:
        box.flash(5, FLASH_US)
        plain.wait_until_dark()  # the caller does nothing at all
        assert not box.lit()
        assert box.end_flash().on_us >= FLASH_US


def test_past_its_time_a_light_is_not_believed_though_nothing_has_ended_it(plain: LedBoxAlone) -> None:
    with plain.opener() as box:
        box.flash(5, FLASH_US)
        with box._lock:  # the thread that is to end it is held up
            plain.clock.sleep(2e-6 * FLASH_US)
            assert plain.shining() == [5]
            assert not box.lit()


def test_a_light_that_could_not_be_ended_in_time_is_not_hidden(plain: LedBoxAlone) -> None:
    with plain.opener() as box:
        box.flash(5, FLASH_US)
        plain.do(plain.box.mute)
        wait_until(lambda: not box.lit(), "the end of the light's time")
        with pytest.raises(DeviceTimeout):
            box.end_flash()


def test_a_box_that_ends_lights_itself_goes_dark_when_its_host_is_gone(tmp_path: Path) -> None:
    with text_world(tmp_path, {"on": "LED {led} ON {on_ms}"}) as world:
        with world.opener() as box:
            box.flash(5, FLASH_US)
            world.do(world.box.mute)  # nothing of the host's comes through any more
            world.wait_until_dark()
        assert world.lit_us(0) > FLASH_US


def test_words_that_nobody_asked_for_are_not_taken_for_an_answer(plain: LedBoxAlone) -> None:
    with plain.opener() as box:
        say(plain, b"boot: brown-out\r\n")
        with pytest.raises(DeviceRefused, match="said `boot: brown-out` unasked"):
            box.flash(5, FLASH_US)
        box.flash(5, LONG_US)  # the line was cleared
        assert plain.shining() == [5]


def test_an_empty_line_that_nobody_asked_for_does_no_harm(plain: LedBoxAlone) -> None:
    with plain.opener() as box:
        say(plain, b"\r\n")
        box.flash(5, LONG_US)
        assert plain.shining() == [5]


def test_a_late_answer_is_not_taken_for_the_next_ones(plain: LedBoxAlone) -> None:
    with plain.opener() as box:
        plain.do(plain.box._link._stop_waiting)  # it hears nothing for a while
        with pytest.raises(DeviceTimeout):
            box.flash(5, FLASH_US)
        plain.do(plain.box._link._wait_for_bytes)
        plain.clock.sleep(0.5)
        with pytest.raises(DeviceRefused, match="an LED from 0 to 63"):
            box.flash(64, FLASH_US)
        box.flash(7, LONG_US)
        assert plain.shining() == [7]


def test_a_stuck_led_shines_on_though_the_box_confirms_that_it_is_off(plain: LedBoxAlone) -> None:
    plain.do(lambda: plain.box.stick_led(5))
    with plain.opener() as box:
        box.flash(5, FLASH_US)
        box.end_flash()
        assert plain.shining() == [5]


def test_a_port_that_does_not_exist_is_a_device_lost(plain: LedBoxAlone) -> None:
    with pytest.raises(DeviceLost, match="nowhere"), plain.opener(port="/dev/nowhere"):
        pass


def test_an_open_port_cannot_be_opened_twice(plain: LedBoxAlone) -> None:
    with plain.opener(), pytest.raises(DeviceLost, match="no other program has it open"), plain.opener():
        pass


def test_a_port_where_nobody_answers_times_out(plain: LedBoxAlone) -> None:
    master, slave = os.openpty()
    tty.setraw(slave)
    with pytest.raises(DeviceTimeout, match="`ALL OFF` within"), plain.opener(port=os.ttyname(slave)):
        pass
    os.close(master)
    os.close(slave)


# -- templates ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"on": "LIGHT ON"}, "it lacks {led}"),
        ({"on": "LED {lamp}{led}"}, "it has {lamp}; allowed: {led}, {on_ms}"),
        ({"on": "LED {}{led}"}, "it has {}"),
        ({"off": "OFF"}, "it lacks {led}"),
        ({"off": "OFF {led} {on_ms}"}, "it has {on_ms}; allowed: {led}"),
        ({"all_off": "OFF {led}"}, "it has {led}; allowed: no field"),
        ({"identify": "WHO {led}"}, "allowed: no field"),
        ({"on": "LED {led"}, "is not a template of a command"),
        ({"on": "LED {led:q}"}, "is not a template of a command"),
        ({"on": "LED {led}\n"}, "one line of printable ASCII"),
        ({"all_off": ""}, "one line of printable ASCII"),
        ({"on": "Lämpchen {led}"}, "one line of printable ASCII"),
    ],
)
def test_a_wrong_template_is_refused_when_the_rig_is_read(changes: dict[str, str], words: str) -> None:
    with pytest.raises(ValidationError) as refused:
        Settings(port="COM3", led_count=64, **changes)  # type: ignore[arg-type]
    assert words in str(refused.value)


# -- replies ------------------------------------------------------------------------------------------------

pieces = st.lists(st.binary(min_size=1, max_size=40), max_size=40)


def from_pieces(given: list[bytes]) -> Callable[[], bytes]:
    rest = iter(given)

    def read() -> bytes:
        for piece in rest:
            return piece
        raise TimeoutError("nothing came")

    return read


@given(st.text(st.characters(min_codepoint=33, max_codepoint=126), min_size=1, max_size=60), st.data())
def test_a_line_is_read_whole_however_it_is_cut(words: str, data: st.DataObject) -> None:
    line = words.encode("ascii") + data.draw(st.sampled_from((b"\n", b"\r\n")))
    cut = data.draw(st.integers(0, len(line)))
    assert read_reply(from_pieces([one for one in (line[:cut], line[cut:]) if one]), "lf") == words


@given(pieces, st.sampled_from(("lf", "crlf", "cr")))
def test_whatever_comes_is_one_line_or_an_error(given_pieces: list[bytes], line_ending: str) -> None:
    ending = b"\r" if line_ending == "cr" else b"\n"
    data = b"".join(given_pieces)
    try:
        reply = read_reply(from_pieces(given_pieces), line_ending)
    except TimeoutError:
        assert ending not in data
    except ValueError:
        assert len(data) > 1000 or data.partition(ending)[2].strip()
    else:
        assert reply.isascii()
        assert "\n" not in reply
        assert ending in data
