"""Steps that time the light: from the trigger's edge to the exposure, and from the host's last command to
darkness."""

from __future__ import annotations

from dataclasses import astuple

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.commissioning.bench import Bench, StepFailedError
from coupole.acquisition.commissioning.flashes import (
    arm_camera,
    good_exposure_us,
    next_frame,
    pixels_of,
    timing_of,
    triggered_by_box,
    wait_for_end,
)
from coupole.devices import NO_LED, STEP_DTYPE, Step, table_box
from coupole.errors import DeviceError
from coupole.plan.bursts import EXPOSURE_MARGIN_US, LED_GAP_US
from coupole.plan.registry import settings_class
from coupole.plan.rig_devices import NOWHERE, device_for

_METERED = 5
_EDGES = 24
_CODE = 0.37
"""The k-th period of the burst of edges is longer by `(k * k * _CODE) mod 1` of the shortest period. So no frame
fits another edge."""
_PAIRS = 8
_LEAST_EXPOSURE_US = 2000
_SEGMENT_US = 200_000
_WATCH_BEYOND_S = 4.0
_DARK_LATE_S = 0.5
"""Tolerance of the box itself: no frame may show light later than the watchdog's time plus this."""
_LEAST_SIGNAL_SIGMA = 8.0


def trigger(bench: Bench) -> None:
    """Delay and jitter from edge to exposure.

    Jitter: camera timestamps are compared with the box's times of its edges, after a straight line between the two
    clocks. Delay: an LED that goes dark in the middle of the exposure gives half of its light. For an exposure of
    E microseconds, every microsecond of delay removes one E-th of the light. The clocks of box and camera cannot
    show a constant delay.
    """
    findings = bench.findings
    findings.remedy = (
        "Check the cable, the polarity and the input filter of the camera's trigger, and its trigger delay; "
        f"the LEDs are lit only {EXPOSURE_MARGIN_US} us longer than the nominal exposure."
    )
    if not bench.opened.ledbox.runs_tables:
        findings.remarks.append("the box has no trigger output: the host triggers the camera, nothing was timed")
        return
    bench.ask_before("Step trigger: the camera is triggered by the box, with one LED and without light.")
    _judge_jitter(bench)
    ids = bench.cell.leds.ids
    exposure_us, led = good_exposure_us(
        bench, ids[np.unique(np.linspace(0, len(ids) - 1, _METERED).astype(int))].tolist()
    )
    exposure_us = max(exposure_us, _LEAST_EXPOSURE_US)
    delays_us = _delays_us(bench, led, exposure_us)
    u_us = float(delays_us.std(ddof=1) / np.sqrt(len(delays_us)))
    findings.remarks.append(f"delay {delays_us.mean():.1f} us, standard uncertainty {u_us:.1f} us, LED {led}")
    findings.at_most(
        "delay from edge to exposure", abs(float(delays_us.mean())) + 2.0 * u_us, EXPOSURE_MARGIN_US, "us"
    )


def _judge_jitter(bench: Bench) -> None:
    findings, camera = bench.findings, bench.opened.camera
    box = table_box(bench.opened.ledbox)
    timing = timing_of(bench, _LEAST_EXPOSURE_US)
    periods_us = [int(timing.period_us * (1.0 + (k * k * _CODE) % 1.0)) for k in range(_EDGES)]
    steps = [Step(NO_LED, timing.on_us, timing.trigger_delay_us, period_us) for period_us in periods_us]
    table = np.array([astuple(step) for step in steps], STEP_DTYPE)
    camera.disarm()
    arm_camera(bench, _LEAST_EXPOSURE_US, hardware=True)
    box.load(table)
    box.start(table)
    wait_for_end(bench, sum(periods_us) * 1e-6)
    edges_ns = box.poll_log()["t_trigger_ns"].astype(np.float64)
    stamps_ns = []
    while (frame := camera.next_frame(camera.delivery_s + timing.period_us * 1e-6)) is not None:
        stamps_ns.append(float(frame.timestamp_ns))
        frame.release()
    if not findings.at_most(
        "edges without a frame, or frames without an edge", abs(len(stamps_ns) - _EDGES), 0, ""
    ):
        return
    x_ns, y_ns = edges_ns - edges_ns.mean(), np.array(stamps_ns) - np.mean(stamps_ns)
    rate = float(x_ns @ y_ns / (x_ns @ x_ns))
    jitter_us = float(np.abs(y_ns - rate * x_ns).max()) / 1e3
    findings.at_most("largest jitter from edge to timestamp", jitter_us, camera.timestamp_jitter_us, "us")
    findings.remarks.append(f"the camera's clock runs at {1e6 * (rate - 1.0):+.1f} ppm of the box's")


def _delays_us(bench: Bench, led: int, exposure_us: int) -> NDArray[np.float64]:
    """Return delays [pairs] from pairs of flashes. One flash is longer than the exposure, the other ends in the
    middle of it."""
    limits = bench.cell.rig.led_limits
    arm_camera(bench, exposure_us, hardware=True)
    dark = triggered_by_box(bench, _flash(bench, NO_LED, exposure_us, exposure_us))[0]
    whole: list[float] = []
    half: list[float] = []
    for _ in range(_PAIRS):
        for sums_dn, lit_us in ((whole, exposure_us + exposure_us // 4), (half, exposure_us // 2)):
            step = _flash(bench, led, exposure_us, lit_us)
            if not limits.on_us[0] <= step.on_us <= limits.on_us[1]:
                raise StepFailedError(f"an LED would be on for {step.on_us} us, out of `led_limits: on_us`")
            sums_dn.append(float((triggered_by_box(bench, step)[0] - dark).sum()))
    delays: NDArray[np.float64] = exposure_us * (0.5 - np.array(half) / np.array(whole))
    return delays


def _flash(bench: Bench, led: int, exposure_us: int, lit_us: int) -> Step:
    """Return a step whose LED goes dark `lit_us` after the edge."""
    limits = bench.cell.rig.led_limits
    on_us = limits.rise_us + lit_us
    rest_us = int(on_us * (1.0 + limits.cooldown_ratio))
    return Step(led, on_us, limits.rise_us, max(rest_us, timing_of(bench, exposure_us).period_us) + LED_GAP_US)


def watchdog(bench: Bench) -> None:
    """Light LEDs by a long table, send no more commands to the box, and see with the camera when the light goes
    out."""
    findings, opened_cell = bench.findings, bench.opened
    findings.remedy = (
        "The box must switch off by itself: check its firmware's watchdog. Do not leave it unattended."
    )
    seconds = _watchdog_s(bench)
    if seconds <= 0.0:
        raise StepFailedError(
            "the rig switches the box's watchdog off: set `watchdog_s` of the led box, 2 for example"
        )
    bench.ask_before(
        "Step watchdog: LEDs are lit in turn, then this machine sends no more commands. The box must switch its "
        f"LEDs off by itself after {seconds:g} s."
    )
    ids = bench.cell.leds.ids
    metered_ids = ids[np.unique(np.linspace(0, len(ids) - 1, _METERED).astype(int))].tolist()
    exposure_us, led = good_exposure_us(bench, metered_ids)
    lit_s, dark_s = _last_light_s(bench, led, exposure_us, seconds)
    findings.remarks.append(
        f"{lit_s:.2f} s after the last command the LEDs were still lit; after {dark_s:.2f} s they were dark"
    )
    findings.at_most("last light after the host's last command", lit_s, seconds + _DARK_LATE_S, "s")
    findings.at_most("lights that stayed on until the end of the test", int(not np.isfinite(dark_s)), 0, "")
    report = ""
    try:
        opened_cell.ledbox.self_test()
    except DeviceError as error:
        report = str(error)
    findings.at_most("watchdogs that the box does not report", 0 if report else 1, 0, "")
    findings.remarks.append(f"the box says: {report or 'nothing'}")
    opened_cell.ledbox.lights_off()


def _last_light_s(bench: Bench, led: int, exposure_us: int, watchdog_s: float) -> tuple[float, float]:
    """Return seconds from the last command to the last frame with light, and to the first dark frame after it
    (infinite without one). Both times are read before the frame's exposure. So a slow machine never makes the box
    look late."""
    opened_cell, clock = bench.opened, bench.opened.clock
    arm_camera(bench, exposure_us, hardware=False)
    darks = [_by_software(bench, exposure_us) for _ in range(3)]
    dark = darks[0]
    noise_dn = max(float(np.std(darks[1] - dark)), 1e-6) / np.sqrt(dark.size)
    table = _lasting_table(bench, led, watchdog_s + _WATCH_BEYOND_S)
    box = table_box(opened_cell.ledbox)
    box.load(table)
    silent_ns = clock.now_ns()
    box.start(table)
    lit: list[tuple[float, bool]] = []
    while (since_s := (clock.now_ns() - silent_ns) / 1e9) < watchdog_s + _WATCH_BEYOND_S - 1.0:
        bench.control.go_on()
        bright_dn = float((_by_software(bench, exposure_us) - dark).mean())
        lit.append((since_s, bright_dn > _LEAST_SIGNAL_SIGMA * noise_dn))
    opened_cell.camera.disarm()
    if not any(on for _, on in lit):
        raise StepFailedError(
            "the camera saw none of the light: jog the arm so that it sees a matte ball, then repeat"
        )
    last = max(k for k, (_, on) in enumerate(lit) if on)
    return lit[last][0], lit[last + 1][0] if last + 1 < len(lit) else np.inf


def _lasting_table(bench: Bench, led: int, seconds: float) -> NDArray[np.void]:
    """Return a table that lights LEDs in turn, without edges, so that each LED can rest. The given LED is one of
    these LEDs.
    """
    limits, ids = bench.cell.rig.led_limits, bench.cell.leds.ids
    at = int(np.flatnonzero(ids == led)[0])
    turn = np.roll(ids, -at)[: int(np.ceil(limits.cooldown_ratio)) + 2]
    on_us = int(np.clip(_SEGMENT_US, *limits.on_us))
    count = int(np.ceil(seconds * 1e6 / on_us))
    leds = [int(turn[k % len(turn)]) for k in range(count)]
    steps = [Step(lit_led, on_us, 0, on_us + LED_GAP_US, sends_edge=False) for lit_led in leds]
    return np.array([astuple(step) for step in steps], STEP_DTYPE)


def _by_software(bench: Bench, exposure_us: int) -> NDArray[np.float64]:
    bench.opened.camera.trigger()
    return pixels_of(next_frame(bench, exposure_us * 1e-6))


def _watchdog_s(bench: Bench) -> float:
    """Return the watchdog's time of the rig's box, as its driver sets it; 0 if the driver knows none."""
    driver, settings = device_for(bench.cell.rig, "ledbox", dry_run=False)
    model = settings_class(driver)
    places = {name: value for name, value in NOWHERE["ledbox"].items() if name in model.model_fields}
    return float(getattr(model(**{**settings, **places}), "watchdog_s", 0.0))
