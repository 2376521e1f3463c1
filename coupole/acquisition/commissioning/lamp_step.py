"""The lamps one by one: each draws current, brightens the picture, and lights from the place that the LED table
says."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.commissioning.bench import Bench, StepFailedError
from coupole.acquisition.commissioning.flashes import arm_camera, good_exposure_us, photograph
from coupole.acquisition.commissioning.light_directions import FEWEST_LEDS, MOST_DEVIATION_DEG, deviations_deg
from coupole.devices import NO_LED
from coupole.plan.led_table import LedTable

_LEAST_SPREAD = 0.05
"""Smallest singular value of the visible normals, as a share of the largest. Below it the object is too flat."""
_LEAST_SIGNAL_SIGMA, _LEAST_SIGNAL_SHARE = 8.0, 0.01
"""Least signal of a picture, that is, its mean minus the mean of its dark frame. The first limit is in standard
deviations of that mean, the second is a share of the median LED's signal."""
_LEAST_CURRENT_SHARE = 0.5
_MOST_PIXELS = 4000
_LIT_SHARE = 0.1
_METERED = 5
_MOST_ASKED = 24
_SHOWN_US = 2_000_000


@dataclass(frozen=True)
class Pictures:
    """Pictures and currents under each LED."""

    ids: NDArray[np.int64]
    pictures: NDArray[np.float64]
    """[leds, pixels] without the dark frame, DN."""
    noise_dn: float
    """Standard deviation of a picture's mean."""
    currents_ma: NDArray[np.float64]
    """[leds] currents; NaN where the box does not measure them."""
    open_leds: list[int]


def lamps(bench: Bench) -> None:
    """Light each LED of the table once and compare the picture with the table."""
    findings, table = bench.findings, bench.cell.leds
    findings.remedy = (
        "Check that LED's wire, driver and board, and its line in the LED table; after swapping wires or lines "
        "repeat the step."
    )
    bench.ask_before(
        f"Step lamps: {len(table.ids)} LEDs are lit one by one. Take every object that light can harm out of the "
        "dome; the camera must see a matte white ball, or another matte body, on the support."
    )
    metered_ids = table.ids[np.unique(np.linspace(0, len(table.ids) - 1, _METERED).astype(int))]
    exposure_us, _ = good_exposure_us(bench, metered_ids.tolist())
    pictures = _take_pictures(bench, exposure_us)
    findings.remarks.append(f"{len(pictures.ids)} LEDs at {exposure_us} us")
    _judge_currents(bench, pictures)
    dark = _dark_leds(pictures)
    dark_and_on = [led for led in dark if led not in pictures.open_leds]
    lit = ~np.isin(pictures.ids, dark)
    if lit.sum() < FEWEST_LEDS:
        raise StepFailedError(
            f"only {lit.sum()} of {len(lit)} LEDs brighten the picture: jog the arm so that the camera sees the "
            "matte ball, then repeat"
        )
    rows = table.rows(pictures.ids[lit])
    off_deg, spread_found = deviations_deg(
        pictures.pictures[lit], light_vectors(bench, table)[rows], bench.iterate
    )
    if spread_found < _LEAST_SPREAD:
        raise StepFailedError(
            f"the visible surface is too flat to show directions of light ({spread_found:.3f}; "
            f"{_LEAST_SPREAD} are needed): put a matte ball on the support, then repeat"
        )
    for led, angle_deg in zip(pictures.ids[lit], off_deg, strict=True):
        if angle_deg > MOST_DEVIATION_DEG:
            findings.at_most(f"LED {led}: angle from its place in the table", angle_deg, MOST_DEVIATION_DEG, "deg")
    findings.at_most("largest deviation from the LED table", float(off_deg.max()), MOST_DEVIATION_DEG, "deg")
    _ask_for_dark_ones(bench, dark_and_on)


def light_vectors(bench: Bench, table: LedTable) -> NDArray[np.float64]:
    """Return [leds, 3]: the direction from the support's centre to each LED, times its illuminance there; base
    frame."""
    centre = bench.cell.rig.support.base_from_support.matrix()[:3, 3]
    towards = table.positions_mm - centre
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    lux = table.illuminance_lux(centre[None], emission=bench.cell.rig.dome.emission)[0]
    vectors: NDArray[np.float64] = towards * lux[:, None]
    return vectors


def _take_pictures(bench: Bench, exposure_us: int) -> Pictures:
    arm_camera(bench, exposure_us, hardware=bench.opened.ledbox.runs_tables)
    darks = [photograph(bench, NO_LED, exposure_us)[0] for _ in range(2)]
    dark = (darks[0] + darks[1]) / 2.0
    noise_dn = float(np.std(darks[0] - darks[1]))
    pictures, currents_ma, open_leds = [], [], []
    for led in bench.iterate("LEDs", bench.cell.leds.ids.tolist()):
        picture, record = photograph(bench, led, exposure_us)
        pictures.append((picture - dark).ravel()[:: max(1, dark.size // (4 * _MOST_PIXELS))])
        currents_ma.append(record.led_current_ma)
        if record.led_open:
            open_leds.append(led)
    bench.opened.camera.disarm()
    all_pictures = np.array(pictures)
    brightest = np.argsort(all_pictures.max(axis=0))[-_MOST_PIXELS:]
    useful = brightest[all_pictures[:, brightest].max(axis=0) > _LIT_SHARE * all_pictures.max()]
    return Pictures(
        bench.cell.leds.ids,
        all_pictures[:, useful],
        noise_dn / max(1, useful.size) ** 0.5,
        np.array(currents_ma),
        open_leds,
    )


def _judge_currents(bench: Bench, pictures: Pictures) -> None:
    findings = bench.findings
    for led in pictures.open_leds:
        findings.at_most(f"LED {led}: steps in which it drew no current", 1, 0, "")
    findings.at_most("LEDs that draw no current", len(pictures.open_leds), 0, "")
    if np.isnan(pictures.currents_ma).all():
        findings.remarks.append("the box measures no currents")
        return
    usual_ma = float(np.nanmedian(pictures.currents_ma))
    weak = pictures.ids[
        (pictures.currents_ma < _LEAST_CURRENT_SHARE * usual_ma) & ~np.isin(pictures.ids, pictures.open_leds)
    ]
    findings.at_most(f"LEDs that draw less than half of {usual_ma:.0f} mA", len(weak), 0, "")
    if len(weak):
        findings.remarks.append(f"they are LEDs {', '.join(map(str, weak))}")


def _dark_leds(pictures: Pictures) -> list[int]:
    means_dn = pictures.pictures.mean(axis=1)
    least_dn = max(_LEAST_SIGNAL_SIGMA * pictures.noise_dn, _LEAST_SIGNAL_SHARE * float(np.median(means_dn)))
    dark_ids: list[int] = pictures.ids[means_dn < least_dn].tolist()
    return dark_ids


def _ask_for_dark_ones(bench: Bench, leds: list[int]) -> None:
    """Ask the person to look at LEDs that draw current but light nothing that the camera sees, because the arm
    hides them."""
    findings, table = bench.findings, bench.cell.leds
    if not findings.at_most("LEDs whose light the camera does not see", len(leds), _MOST_ASKED, ""):
        findings.remarks.append(
            f"they are LEDs {', '.join(map(str, leds))}; is the arm in their way? Jog it aside"
        )
        return
    support = bench.cell.rig.support.base_from_support.matrix()
    for led in leds:
        (row,) = table.rows([led])
        x, y, z = support[:3, :3].T @ (table.positions_mm[row] - support[:3, 3])
        place = (
            f"board {table.boards[row]}, azimuth {np.degrees(np.arctan2(y, x)) % 360.0:.0f} deg, elevation "
            f"{np.degrees(np.arctan2(z, np.hypot(x, y))):.0f} deg"
        )
        bench.ask_before(f"LED {led} ({place}) lights for {_SHOWN_US / 1e6:g} s: look there.")
        bench.opened.ledbox.flash(led, min(_SHOWN_US, bench.cell.rig.led_limits.on_us[1]))
        bench.opened.ledbox.end_flash()
        bench.ask_whether(f"Was LED {led} lit ({place}), and no other?")
