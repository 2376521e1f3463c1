"""Pictures under one light at a time. There is only one edge or one software trigger, so the frame cannot belong
to another."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.commissioning.bench import Bench, StepFailedError
from coupole.clock import Deadline
from coupole.devices import NO_LED, STEP_DTYPE, Exposure, Frame, Step, StepRecord, table_box
from coupole.errors import DeviceError, DeviceTimeout
from coupole.plan.bursts import LED_GAP_US, BurstTiming, burst_timing
from coupole.plan.rig_devices import device_times

_FRAME_S = 2.0
_BUFFERS = 8
_FIRST_EXPOSURE_US, _SHORTEST_EXPOSURE_US = 8000, 100
_DIM, _BRIGHT = 0.2, 0.9
_TRIES = 8


def timing_of(bench: Bench, exposure_us: int) -> BurstTiming:
    """Return the times of a flash that covers an exposure."""
    return burst_timing(exposure_us, device_times(bench.cell.rig), hardware=bench.opened.ledbox.runs_tables)


def arm_camera(bench: Bench, exposure_us: int, *, hardware: bool) -> None:
    """Arm the camera for frames of this exposure."""
    camera = bench.opened.camera
    camera.disarm()
    camera.configure(Exposure(exposure_us, hardware_trigger=hardware))
    camera.arm(_BUFFERS)


def photograph(bench: Bench, led: int, exposure_us: int) -> tuple[NDArray[np.float64], StepRecord]:
    """Return the picture [H, W] in DN under one LED (NO_LED: none), and the box's record of the flash. The camera
    must be armed for this exposure. If the box has a trigger, it must be armed for this trigger."""
    timing, rig = timing_of(bench, exposure_us), bench.cell.rig
    rest_us = int(timing.on_us * (1.0 + rig.led_limits.cooldown_ratio))
    step = Step(led, timing.on_us, timing.trigger_delay_us, max(timing.period_us, rest_us))
    if bench.opened.ledbox.runs_tables:
        return triggered_by_box(bench, step)
    bench.control.go_on()
    bench.opened.ledbox.flash(led, timing.on_us)
    bench.opened.clock.sleep(timing.trigger_delay_us * 1e-6)
    bench.opened.camera.trigger()
    pixels = pixels_of(next_frame(bench, timing.on_us * 1e-6))
    return pixels, bench.opened.ledbox.end_flash()


def triggered_by_box(bench: Bench, step: Step) -> tuple[NDArray[np.float64], StepRecord]:
    """Take the picture by a table with this one step; return picture and record as `photograph` does."""
    bench.control.go_on()
    box = table_box(bench.opened.ledbox)
    table = np.array([astuple(step)], STEP_DTYPE)
    box.load(table)
    box.start(table)
    pixels = pixels_of(next_frame(bench, step.period_us * 1e-6))
    wait_for_end(bench, step.period_us * 1e-6)
    records = box.poll_log()
    if len(records) != 1:
        bench.control.go_on()
        raise DeviceError(
            "led box",
            expected="a log record of the step that has ended",
            happened=f"{len(records)} came",
            remedy="Find out what else commands the box, then repeat the step.",
        )
    return pixels, StepRecord(*records[0].tolist())


def next_frame(bench: Bench, within_s: float) -> Frame:
    """Return the next frame. Raises DeviceTimeout if no frame comes."""
    seconds = within_s + _FRAME_S
    frame = bench.opened.camera.next_frame(seconds)
    if frame is None:
        raise DeviceTimeout(
            "camera",
            expected=f"a frame within {seconds:.1f} s of its trigger",
            happened="none came",
            remedy="Check the trigger cable and the camera's trigger settings, then repeat the step.",
        )
    return frame


def pixels_of(frame: Frame) -> NDArray[np.float64]:
    """Return a copy of the pixels. The frame's buffer goes back to the camera."""
    pixels = frame.pixels.astype(np.float64)
    frame.release()
    return pixels


def wait_for_end(bench: Bench, duration_s: float) -> None:
    """Wait until the box has run its table."""
    box = table_box(bench.opened.ledbox)
    deadline = Deadline(bench.opened.clock, 2.0 * duration_s + _FRAME_S)
    while box.running():
        if deadline.has_expired:
            raise DeviceTimeout(
                "led box",
                expected=f"a table of {duration_s:.3f} s to end within {deadline.seconds:.1f} s",
                happened="the box reports that it is still running",
                remedy="Check the box.",
            )
        bench.opened.clock.sleep(min(0.01, duration_s))


def good_exposure_us(bench: Bench, leds: list[int]) -> tuple[int, int]:
    """Return an exposure at which the brightest pixel under these LEDs is well below saturation, and the LED that
    lights this pixel. Raises StepFailedError if the camera sees too little or too much."""
    limits = bench.cell.rig.led_limits
    longest_us = limits.on_us[1] - limits.rise_us - 2 * LED_GAP_US
    exposure_us, white = _FIRST_EXPOSURE_US, float(bench.cell.rig.sensor.white_dn)
    for _ in range(_TRIES):
        arm_camera(bench, exposure_us, hardware=bench.opened.ledbox.runs_tables)
        dark, _ = photograph(bench, NO_LED, exposure_us)
        black = float(np.median(dark))
        peaks = [(float(photograph(bench, led, exposure_us)[0].max()) - black) / (white - black) for led in leds]
        brightest = int(np.argmax(peaks))
        if _DIM <= peaks[brightest] <= _BRIGHT:
            return exposure_us, leds[brightest]
        factor = 0.25 if peaks[brightest] > _BRIGHT else min(8.0, 0.5 / max(peaks[brightest], 1e-3))
        wanted_us = int(np.clip(exposure_us * factor, _SHORTEST_EXPOSURE_US, longest_us))
        if wanted_us == exposure_us:
            break
        exposure_us = wanted_us
    raise StepFailedError(
        f"at {exposure_us} us the brightest pixel under {len(leds)} LEDs has {peaks[brightest]:.0%} of full "
        "scale: "
        "put a matte white ball on the support, jog the arm so that the camera sees it, open the lens; then repeat"
    )
