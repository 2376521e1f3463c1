"""Proves `exposure: {kind: auto}` on a gilded wedge beside black lacquer, in the simulated cell in real time.

    python tools/prove_auto_exposure.py [--every N] [--snr SNR] [--keep FOLDER]

There are three runs of one view, with every N-th LED. The first is a reference with a wide bracket, taken twice;
it gives each pixel's rate under each LED, and the noise. The second is the auto exposure. The third is the best
fixed bracket, found by search in the reference. It has one to three times, in steps of an eighth of a stop. Among
the brackets that leave no more LEDs clipped or noisy than the auto exposure, it has the shortest tables.

Clipped shares and noise are judged by the reference. Durations are from the begin of the first burst to the end of
the last, with all choices. Exits with 1 unless clipped pixels and noise are within the plan's limits, the auto
exposure takes at most 1.15 times the bracket's time, and its light, time and bytes are below preflight's figures;
not with `--smallest`.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import cells  # noqa: E402

from coupole.preflight.job import read_job  # noqa: E402
from smallest import add_smallest  # noqa: E402

FULL_DN = 4095 - cells.BLACK_DN
CLIPPED_SHARE, OBJECT_SHARE, LIT = 1e-3, 0.9, 0.1
REFERENCE_US = (250, 2000, 16000, 128000)
SHORTEST_US, LONGEST_US = REFERENCE_US[0], REFERENCE_US[-1]
MOST_OF_BEST = 1.15
ALLOWED_NOISY = 0.03
"""Share of LEDs for which the reference may judge the noise differently than the run's own frames."""
LACQUER = {"diffuse": (0.01, 0.01, 0.01), "f0": (0.04, 0.04, 0.04), "roughness": 0.1}
Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Reference:
    """The scene under each LED, by the reference run."""

    rates: dict[int, Floats]
    """[pixels] DN per us."""
    lit: dict[int, NDArray[np.bool_]]
    """[pixels] True on the object, where the LED's light reaches it."""
    read_dn: float
    gain_dn: float

    def clipped_share(self, led: int, times_us: Sequence[float]) -> float:
        """Return the share of the pixels that the shortest exposure clips."""
        return float(np.mean(self.rates[led] * min(times_us) >= FULL_DN))

    def reached_share(self, led: int, times_us: Sequence[float], snr: float) -> float:
        """Return the share of the lit pixels that reach the ratio with all exposures together."""
        rate = self.rates[led][self.lit[led]]
        weight = np.zeros(len(rate))
        for time_us in times_us:
            variance = (self.read_dn**2 + self.gain_dn * np.maximum(rate * time_us, 0.0)) / time_us**2
            weight += np.where(rate * time_us < FULL_DN, 1.0 / variance, 0.0)
        return float(np.mean(rate * np.sqrt(weight) >= snr)) if len(rate) else 1.0


def scene(folder: Path, every: int) -> cells.CellFolder:
    """Return a cell with the gilded wedge and a plate of black lacquer beside it."""
    folder.mkdir(parents=True)
    cell = cells.CellFolder(folder, speed=1.0)
    plate = trimesh.creation.box((120.0, 60.0, 8.0))
    plate.apply_translation((0.0, 36.0, 4.0))
    plate.export(folder / "plate.ply")
    cell.plan_data["object"] = {"id": "lacquer", "mesh": str(folder / "plate.ply")}
    wedge = {"kind": "gilt_step_wedge", "translation_mm": [0, -20, 0]}
    cell.world_settings.update(
        material=LACQUER, shading="pixel", interreflection=False, white_at_us=8000, things=[wedge]
    )
    view = {**cells.TOP, "target_mm": [0, 0, 8], "elevation_deg": 70}
    cell.write(views=[view], lights={"kind": "every", "every": every})
    return cell


def acquire(cell: cells.CellFolder, **plan: Any) -> tuple[dict[str, cells.Stored], dict[str, Any]]:
    """Acquire a plan; return its frames, and the output of the command."""
    cell.write(**plan)
    result = cell.acquire()
    if result.code:
        raise SystemExit(f"the run ended with {result.code}: {result.err[-2000:]}")
    return cells.stored(cell.run_folder), result.document


def signals(frames: dict[str, cells.Stored]) -> dict[int, list[tuple[int, Floats]]]:
    """Return exposure, us, and signal above black, DN, of the frames of each LED."""
    of_led: dict[int, list[tuple[int, Floats]]] = {}
    for shot, frame in frames.items():
        if cells.is_light(shot):
            signal = frame.pixels.astype(float).ravel() - cells.BLACK_DN
            of_led.setdefault(int(frame.record["led"]), []).append((int(frame.record["exposure_us"]), signal))
    return of_led


def reference(cell: cells.CellFolder) -> Reference:
    """Return rates by the longest exposures that do not clip, and noise by pairs of frames."""
    bracket = {"kind": "bracket", "exposures_us": list(REFERENCE_US)}
    frames, _ = acquire(cell, exposure=bracket, repeats=2)
    of_led = signals(frames)
    means, variances = [], []
    rates = {}
    for led, exposures in of_led.items():
        rate = np.full(exposures[0][1].shape, np.inf)
        for time_us in REFERENCE_US:
            a, b = (signal for own_us, signal in exposures if own_us == time_us)
            below_full = np.maximum(a, b) < FULL_DN
            rate = np.where(below_full, (a + b) / 2.0 / time_us, rate)
            means.append(((a + b) / 2.0)[below_full])
            variances.append(((a - b) ** 2 / 2.0)[below_full])
        rates[led] = np.where(np.isfinite(rate), rate, FULL_DN / SHORTEST_US)
    mean, variance = np.concatenate(means), np.concatenate(variances)
    edges = np.quantile(mean, np.linspace(0.0, 1.0, 41))
    level = np.clip(np.searchsorted(edges, mean) - 1, 0, 39)
    count = np.bincount(level, minlength=40)
    mean_of_level, variance_of_level = (np.bincount(level, v, minlength=40) / count for v in (mean, variance))
    weight = np.sqrt(count) / variance_of_level
    gain_dn, offset = np.polyfit(mean_of_level, variance_of_level, 1, w=weight)
    job = read_job(cell.plan)
    lux = job.cell.leds.illuminance_lux(
        job.cell.rig.support.base_from_support.matrix()[None, :3, 3], emission=job.cell.rig.dome.emission
    )[0]
    lux_of = {int(led): float(value) for led, value in zip(job.cell.leds.ids, lux, strict=True)}
    relative = np.stack([rates[led] / lux_of[led] for led in rates])
    usual = np.quantile(relative, 0.75, axis=0)
    is_object = np.mean([rates[led] for led in rates], axis=0) * LONGEST_US > 20.0
    lit = {led: is_object & (rates[led] / lux_of[led] >= LIT * usual) for led in rates}
    return Reference(rates, lit, float(np.sqrt(max(offset, 0.0))), float(gain_dn))


def failing(truth: Reference, times_of: Mapping[int, Sequence[float]], snr: float) -> tuple[int, int]:
    """Return the numbers of LEDs that clip more than allowed, and of LEDs that are too noisy."""
    clipped_leds = sum(truth.clipped_share(led, times_us) > CLIPPED_SHARE for led, times_us in times_of.items())
    noisy_leds = sum(truth.reached_share(led, times_us, snr) < OBJECT_SHARE for led, times_us in times_of.items())
    return clipped_leds, noisy_leds


def best_bracket(truth: Reference, period_us: Any, snr: float, most_failing: tuple[int, int]) -> tuple[int, ...]:
    """Return the fixed bracket with the shortest tables that leaves no more LEDs failing than allowed."""
    ladder = [round(SHORTEST_US * 2.0 ** (step / 8)) for step in range(8 * 9 + 1)]
    leds = list(truth.rates)

    def is_enough(times_us: Sequence[int]) -> bool:
        clipped_leds, noisy_leds = failing(truth, dict.fromkeys(leds, times_us), snr)
        return clipped_leds <= most_failing[0] and noisy_leds <= most_failing[1]

    below_full = [t for t in ladder if failing(truth, dict.fromkeys(leds, (t,)), 0.0)[0] <= most_failing[0]]
    shortest = max(below_full, default=ladder[0])
    best_us, best = np.inf, (ladder[0], ladder[-1])
    for middle in [(), *((t,) for t in ladder if t > shortest)]:
        longer = [t for t in ladder if t > max((shortest, *middle))]
        low, high = 0, len(longer)
        while low < high:  # the shortest sufficient time among the longest times
            probe = (low + high) // 2
            low, high = (low, probe) if is_enough((shortest, *middle, longer[probe])) else (probe + 1, high)
        for bracket in [(shortest, *middle), *([(shortest, *middle, longer[low])] if low < len(longer) else [])]:
            total_us = sum(map(period_us, bracket))
            if total_us < best_us and is_enough(bracket):
                best_us, best = total_us, bracket
    return tuple(best)


def bursts_s(cell: cells.CellFolder) -> float:
    """Return the time from the begin of the first burst to the end of the last, by the journal."""
    begins = [datetime.fromisoformat(event["t"]) for event in cells.events(cell.run_folder, "begin")]
    ends = [datetime.fromisoformat(event["t"]) for event in cells.events(cell.run_folder, "burst")]
    return (ends[-1] - begins[0]).total_seconds()


def slowest_choice_s(cell: cells.CellFolder) -> float:
    """Return the longest time from the end of a burst to the next choice."""
    slowest_s, end = 0.0, None
    for event in cells.events(cell.run_folder):
        at = datetime.fromisoformat(event["t"])
        if event["event"] == "chosen" and end is not None:
            slowest_s = max(slowest_s, (at - end).total_seconds())
        end = at if event["event"] == "burst" else end
    return slowest_s


def prove(folder: Path, every: int, snr: float) -> bool:
    """Print the figures; return True if all are within their limits."""
    truth = reference(scene(folder / "reference", every))
    print(
        f"noise: {truth.read_dn:.2f} DN in the dark, {truth.gain_dn:.3f} DN per electron; {len(truth.rates)} LEDs"
    )
    cell = scene(folder / "auto", every)
    wishes = {"snr": snr, "object_share": OBJECT_SHARE, "clipped_share": CLIPPED_SHARE}
    cell.write(exposure={"kind": "auto", "shortest_us": SHORTEST_US, "longest_us": LONGEST_US, **wishes})
    preflight = cells.here("check", cell.plan, "--json").document
    frames, result = acquire(cell)
    for event in cells.events(cell.run_folder, "chosen"):
        print(f"  {event['reason']}")
    times_of = {led: sorted({t for t, _ in own}) for led, own in signals(frames).items()}
    clipped_share = max(
        float(np.mean(min(own, key=lambda pair: pair[0])[1] >= FULL_DN)) for own in signals(frames).values()
    )
    clipped_leds, noisy_leds = failing(truth, times_of, snr)
    job = read_job(cell.plan)
    periods = {b.timing.exposure_us: b.timing.period_us for b in job.schedule.planned_bursts()[0]}
    exposures_us = np.array(sorted(periods))
    bracket = best_bracket(
        truth,
        lambda t: np.interp(t, exposures_us, [periods[k] for k in exposures_us]),
        snr,
        (clipped_leds, noisy_leds),
    )
    fixed_cell = scene(folder / "fixed", every)
    exposure: dict[str, Any] = {"kind": "bracket", "exposures_us": list(bracket)}
    if len(bracket) == 1:
        exposure = {"kind": "fixed", "exposure_us": bracket[0]}
    _, fixed_result = acquire(fixed_cell, exposure=exposure)
    ratio = bursts_s(cell) / bursts_s(fixed_cell)
    worst = max(truth.clipped_share(led, times_us) for led, times_us in times_of.items())
    print(f"auto: clipped share at most {clipped_share:.5f} in its frames ({worst:.5f} by the reference), "
          f"{noisy_leds} of {len(times_of)} LEDs noisier than asked for by the reference")  # fmt: skip
    print(f"best fixed bracket: {', '.join(f'{t / 1e3:g}' for t in bracket)} ms")
    print(f"duration: auto {bursts_s(cell):.1f} s, bracket {bursts_s(fixed_cell):.1f} s, ratio {ratio:.3f}")
    print(f"slowest choice: {slowest_choice_s(cell):.2f} s")
    print(f"light: auto {result['dose_lux_h']:.3f}, bracket {fixed_result['dose_lux_h']:.3f} lux h; "
          f"preflight allowed {preflight['dose_lux_h']:.3f}")  # fmt: skip
    print(f"time: {result['duration_s']:.1f} s of {preflight['duration_s']:.1f}; "
          f"bytes: {result['bytes']} of {preflight['bytes']}")  # fmt: skip
    within = all(result[key] <= preflight[key] for key in ("dose_lux_h", "duration_s", "bytes"))
    print(json.dumps({"name": "auto_exposure_over_best_bracket", "value": round(ratio, 4), "unit": "1"}))
    is_exposed = clipped_share <= CLIPPED_SHARE and noisy_leds <= ALLOWED_NOISY * len(times_of)
    return within and is_exposed and ratio <= MOST_OF_BEST


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--every", type=int, default=8, help="each n-th LED of the dome")
    parser.add_argument("--snr", type=float, default=15.0)
    parser.add_argument("--keep", type=Path, help="a new folder for the runs")
    add_smallest(parser, every=40)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        is_proven = prove(options.keep or Path(folder) / "runs", options.every, options.snr)
    return int(not options.smallest and not is_proven)


if __name__ == "__main__":
    sys.exit(main())
