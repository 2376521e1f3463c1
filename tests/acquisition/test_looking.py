"""How a live view ends."""

from __future__ import annotations

import os
import signal
import threading
from typing import Any

import pytest

from coupole.acquisition.looking import _show_live
from coupole.errors import DeviceError, Interrupted
from coupole.viewing.live import Choice, Studio
from coupole.viewing.terminal import make_console


class Source:
    """A box whose calls are ended when its lights are switched off, which is an error of its own."""

    leds = (1, 2)

    def __init__(self) -> None:
        self.halted = threading.Event()

    def frames(self, studio: Studio) -> None:
        self.halted.wait(10.0)
        raise DeviceError("led box", expected="time", happened="the lights were switched off", remedy="None.")


def show(source: Source) -> None:
    live: Any = source
    _show_live(live, Studio(Choice(None, 0)), make_console(quiet=True), 0, longest_us=0, halt=source.halted.set)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_what_stopping_does_to_a_call_in_progress_is_no_failure(number: signal.Signals) -> None:
    source = Source()
    threading.Timer(0.3, os.kill, (os.getpid(), number)).start()
    if number == signal.SIGINT:
        show(source)
    else:
        with pytest.raises(Interrupted):
            show(source)
    assert source.halted.is_set(), "at once, before the source was waited for"


def test_a_failure_that_nobody_asked_for_ends_it() -> None:
    source = Source()
    source.halted.set()
    with pytest.raises(DeviceError, match="the lights were switched off"):
        show(source)
