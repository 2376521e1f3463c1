"""The lamps one by one: each draws current, brightens the picture, and lights from where the LED table has it.

Of a matte object with a constant shape, a pixel's value under a far light is `l . b`: l the direction of the light
times its illuminance, b the pixel's normal times its reflectance (Woodham, "Photometric method for determining
surface orientation from multiple images", Opt. Eng. 19, 1980). All pictures together give b from the table's
directions; each picture then gives a direction, to be compared with the table's. No pixel's shape has to be known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from coupole.acquisition.commissioning.bench import Bench, StepFailedError
from coupole.acquisition.commissioning.flashes import arm_camera, good_exposure_us, photograph
from coupole.devices import NO_LED
from coupole.plan.led_table import LedTable

MOST_DEVIATION_DEG = 25.0
"""Between the direction in a picture and the table's. Shadows, gloss and the nearness of the LEDs bend it; LEDs
that are swapped within this angle are found by `coupole calibrate leds`."""
_FEWEST_LEDS = 8
_LEAST_SPREAD = 0.05
"""Smallest singular value of the normals in view, as a share of the largest: below it the object is too flat."""
_LEAST_SIGNAL_SIGMA, _LEAST_SIGNAL_SHARE = 8.0, 0.01
"""Of a picture's mean over its dark frame: in standard deviations of that mean, and as a share of the median
LED's."""
_LEAST_CURRENT_SHARE = 0.5
_MOST_PIXELS = 4000
_LIT_SHARE = 0.1
_METERED = 5
_MOST_ASKED = 24
_SHOWN_US = 2_000_000
_ROUNDS = 4


@dataclass(frozen=True)
class Pictures:
    """What was seen under each LED."""

    ids: NDArray[np.int64]
    pictures: NDArray[np.float64]
    """[leds, pixels] without the dark frame, DN."""
    noise_dn: float
    """Standard deviation of a picture's mean."""
    currents_ma: NDArray[np.float64]
    """[leds]; NaN where the box does not measure them."""
    open_leds: list[int]


def lamps(bench: Bench) -> None:
    """Light each LED of the table once and compare what the camera sees with the table."""
    findings, table = bench.findings, bench.cell.leds
    findings.remedy = (
        "See that LED's wire, driver and board, and its line in the LED table; after swapping wires or lines "
        "repeat "
        "the step."
    )
    bench.ask_before(
        f"Step lamps: {len(table.ids)} LEDs are lit one by one. Take every object that light can harm out of the "
        "dome; the camera must see a matte white ball, or another matte body, on the support."
    )
    spread = table.ids[np.unique(np.linspace(0, len(table.ids) - 1, _METERED).astype(int))]
    exposure_us, _ = good_exposure_us(bench, spread.tolist())
    seen = _photographed(bench, exposure_us)
    findings.remarks.append(f"{len(seen.ids)} LEDs at {exposure_us} us")
    _judge_currents(bench, seen)
    dark = _dark_leds(seen)
    dark_and_on = [led for led in dark if led not in seen.open_leds]
    lit = ~np.isin(seen.ids, dark)
    if lit.sum() < _FEWEST_LEDS:
        raise StepFailedError(
            f"only {lit.sum()} of {len(lit)} LEDs brighten the picture: jog the arm so that the camera sees the "
            "matte ball, then repeat"
        )
    rows = table.rows(seen.ids[lit])
    off_deg, spread_found = deviations_deg(seen.pictures[lit], light_vectors(bench, table)[rows])
    if spread_found < _LEAST_SPREAD:
        raise StepFailedError(
            f"what the camera sees is too flat to tell directions of light ({spread_found:.3f}; "
            f"{_LEAST_SPREAD} are needed): put a matte ball on the support, then repeat"
        )
    for led, angle_deg in zip(seen.ids[lit], off_deg, strict=True):
        if angle_deg > MOST_DEVIATION_DEG:
            findings.at_most(f"LED {led}: from its place in the table", angle_deg, MOST_DEVIATION_DEG, "deg")
    findings.at_most("largest deviation from the LED table", float(off_deg.max()), MOST_DEVIATION_DEG, "deg")
    _ask_for_dark_ones(bench, dark_and_on)


def light_vectors(bench: Bench, table: LedTable) -> NDArray[np.float64]:
    """[leds, 3] direction to each LED from the support's centre times its illuminance there; base frame."""
    centre = bench.cell.rig.support.base_from_support.matrix()[:3, 3]
    towards = table.positions_mm - centre
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    lux = table.illuminance_lux(centre[None], emission=bench.cell.rig.dome.emission)[0]
    vectors: NDArray[np.float64] = towards * lux[:, None]
    return vectors


def deviations_deg(
    pictures: NDArray[np.float64], lights: NDArray[np.float64]
) -> tuple[NDArray[np.float64], float]:
    """Angles [leds] between the directions that pictures [leds, pixels] show and `lights` [leds, 3]; and how well
    the object in view tells directions: the ratio of the smallest to the largest singular value of its normals.

    Each LED's direction comes from normals that the other pictures give; those whose LED turned out to be
    elsewhere are left out of them.
    """
    lights = lights / np.linalg.norm(lights, axis=1).mean()
    lit = pictures > _LIT_SHARE * np.maximum(pictures.max(axis=0), 1e-9)
    good = np.ones(len(lights), bool)
    angles_deg = np.zeros(len(lights))
    for _ in range(_ROUNDS):
        for led in range(len(lights)):
            normals = _normals(pictures, lights, lit, good & (np.arange(len(lights)) != led))
            angles_deg[led] = _angle_deg(_direction(pictures[led], normals, lit[led]), lights[led])
        # The worst only: one wrong LED bends the normals by which its neighbours are judged.
        worst = np.where(good, angles_deg, 0.0).argmax()
        if angles_deg[worst] <= MOST_DEVIATION_DEG or good.sum() <= _FEWEST_LEDS:
            break
        good = good & (angles_deg < max(MOST_DEVIATION_DEG, 0.7 * angles_deg[worst]))
    spread = np.linalg.svd(_normals(pictures, lights, lit, good), compute_uv=False)
    return angles_deg, float(spread[-1] / max(spread[0], 1e-12))


def _normals(
    pictures: NDArray[np.float64], lights: NDArray[np.float64], lit: NDArray[np.bool_], used: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """[3, pixels]: for each pixel the least-squares solution of `lights . b = picture` over the lights that reach
    it. Pixels that fewer than four reach count as black."""
    weights = (lit & used[:, None]).astype(np.float64)
    matrices = np.einsum("lp,li,lj->pij", weights, lights, lights) + 1e-6 * np.eye(3)
    sides = np.einsum("lp,li,lp->pi", weights, lights, pictures)
    solved = np.linalg.solve(matrices, sides[..., None])[..., 0].T
    normals: NDArray[np.float64] = np.where(weights.sum(axis=0) < 4, 0.0, solved)
    return normals


def _direction(
    picture: NDArray[np.float64], normals: NDArray[np.float64], lit: NDArray[np.bool_]
) -> NDArray[np.float64]:
    return np.asarray(np.linalg.lstsq(normals[:, lit].T, picture[lit], rcond=None)[0], dtype=np.float64)


def _angle_deg(a: NDArray[np.float64], b: NDArray[np.float64]) -> float:
    cosine = float(a @ b) / max(float(np.linalg.norm(a) * np.linalg.norm(b)), 1e-12)
    return float(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def _photographed(bench: Bench, exposure_us: int) -> Pictures:
    arm_camera(bench, exposure_us, hardware=bench.opened.ledbox.runs_tables)
    darks = [photograph(bench, NO_LED, exposure_us)[0] for _ in range(2)]
    dark = (darks[0] + darks[1]) / 2.0
    noise_dn = float(np.std(darks[0] - darks[1]))
    pictures, currents_ma, open_leds = [], [], []
    for led in bench.cell.leds.ids.tolist():
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


def _judge_currents(bench: Bench, seen: Pictures) -> None:
    findings = bench.findings
    for led in seen.open_leds:
        findings.at_most(f"LED {led}: steps in which it drew no current", 1, 0, "")
    findings.at_most("LEDs that draw no current", len(seen.open_leds), 0, "")
    if np.isnan(seen.currents_ma).all():
        findings.remarks.append("the box measures no currents")
        return
    usual_ma = float(np.nanmedian(seen.currents_ma))
    weak = seen.ids[(seen.currents_ma < _LEAST_CURRENT_SHARE * usual_ma) & ~np.isin(seen.ids, seen.open_leds)]
    findings.at_most(f"LEDs that draw less than half of {usual_ma:.0f} mA", len(weak), 0, "")
    if len(weak):
        findings.remarks.append(f"they are LEDs {', '.join(map(str, weak))}")


def _dark_leds(seen: Pictures) -> list[int]:
    means_dn = seen.pictures.mean(axis=1)
    least_dn = max(_LEAST_SIGNAL_SIGMA * seen.noise_dn, _LEAST_SIGNAL_SHARE * float(np.median(means_dn)))
    found: list[int] = seen.ids[means_dn < least_dn].tolist()
    return found


def _ask_for_dark_ones(bench: Bench, leds: list[int]) -> None:
    """LEDs that draw current and light nothing that the camera sees (the arm hides them): a person looks."""
    findings, table = bench.findings, bench.cell.leds
    if not findings.at_most("LEDs that the camera does not see the light of", len(leds), _MOST_ASKED, ""):
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
