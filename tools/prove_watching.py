"""Proves the watching of a run in the simulated cell: faults are found within the view and named, with few false
alarms.

    python tools/prove_watching.py [--faults N] [--clean N] [--every N] [--seed S]

A seed determines the views of the relief: poses, LEDs that differ from their table and flicker, noise. The
simulated camera's frames of a burst with sentinels, at the times of the table, are reduced and judged as in a run.
In N views one fault of seven kinds happens, at a random moment and with a random size; N views have no fault.
Exits with 1 if a fault is missed or misnamed, if a wrong LED is named, or if more than one in a hundred views
without a fault has a finding.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

ROOT = Path(__file__).resolve().parent.parent
sys.path[:0] = [str(ROOT), str(ROOT / "tests")]

import cells  # noqa: E402

from coupole.acquisition.watching.burst_judge import BurstJudge, FirstFrames  # noqa: E402
from coupole.acquisition.watching.findings import Found, SeenFrame  # noqa: E402
from coupole.acquisition.watching.frame_look import LookGrid  # noqa: E402
from coupole.acquisition.watching.watched_run import judge_of  # noqa: E402
from coupole.devices import NO_LED, FrameFormat  # noqa: E402
from coupole.geometry import inverse, look_at  # noqa: E402
from coupole.plan.bursts import Burst  # noqa: E402
from coupole.plan.shot_id import Sentinel  # noqa: E402
from coupole.preflight.job import Job, read_job  # noqa: E402
from coupole.preflight.simulated_world import world_config  # noqa: E402
from sim.devices.camera_body import Exposed  # noqa: E402
from sim.optics.disturbances import Disturber  # noqa: E402
from sim.optics.led_light import Flashes, LedModel  # noqa: E402
from sim.optics.photographer import Photographer  # noqa: E402
from sim.world import faults as script  # noqa: E402
from sim.world.config import Config  # noqa: E402
from smallest import add_smallest  # noqa: E402

ALLOWED_ALARMS = 0.01
VIEWS = 10
"""Poses. Pictures of the same pose share computations, but not their noise and their faults."""


@dataclass
class Scene:
    """A cell without a world: its job, its camera, its poses."""

    job: Job
    photographer: Photographer
    burst: Burst
    grid: LookGrid
    poses: list[NDArray[np.float64]]
    leds: LedModel
    frame_number: int = 0

    def looks(
        self, pose: int, disturber: Disturber, unsteady: dict[int, float], faults: dict[int, list[Any]]
    ) -> list[SeenFrame]:
        """Yield the looks of a burst from a pose, with faults that happen at steps of its table."""
        flashes = Flashes(self.leds)
        table, frames = self.burst.table, []
        starts_ns = np.concatenate([[0], np.cumsum(table["period_us"][:-1], dtype=np.int64)]) * 1000
        pixels = np.empty((self.grid.frame_format.height_px, self.grid.frame_format.width_px), np.uint16)
        exposure_s = self.burst.timing.exposure_us * 1e-6
        for step, label in enumerate(self.burst.labels):
            now_ns = int(starts_ns[step])
            for fault in faults.get(step, ()):
                disturber.happen(fault, now_ns)
            flashes.unsteady = unsteady
            led = int(table["led"][step])
            lit = (
                {} if led == NO_LED else {led: exposure_s * flashes.flux(led, 25.0) * disturber.flux(led, now_ns)}
            )
            number, self.frame_number = self.frame_number, self.frame_number + 1
            exposure = Exposed(
                lit, [], exposure_s, 1.0, number, self.poses[pose], disturbance=disturber.at(now_ns)
            )
            self.photographer.render(pixels, exposure)
            assert label is not None
            frames.append(SeenFrame(label, self.grid.look(pixels)))
        return frames


def scene(folder: Path, every: int, seed: int) -> Scene:
    """Return the small cell of the tests, with LEDs that differ and flicker like real ones."""
    cell = cells.CellFolder(folder)
    cell.write(lights={"kind": "every", "every": every}, watch=True)
    job = read_job(cell.plan)
    config = world_config(job.cell, job, job.cell.rig.sensor)
    config["settings"]["camera"] |= {"samples_per_side": 3}  # pixels integrate over their area
    config["settings"]["leds"] = {"seed": seed, "flux_spread": 0.01, "pump_spread_nm": 0.0}
    world = Config.model_validate(config)
    photographer = Photographer(world.scene, world.rendered_camera, world.settings)
    sensor = job.cell.rig.sensor
    frame_format = FrameFormat(
        height_px=sensor.height_px,
        width_px=sensor.width_px,
        bit_depth=sensor.bit_depth,
        bayer_pattern=sensor.bayer_pattern,
        black_dn=sensor.black_dn,
        white_dn=sensor.white_dn,
    )
    random = np.random.default_rng(seed)
    base_from_support = job.cell.rig.support.base_from_support.matrix()
    camera_from_flange = inverse(job.cell.rig.flange_from_camera.matrix())
    poses = []
    for _ in range(VIEWS):
        target_mm = (*random.uniform(-20.0, 20.0, 2), 30.0)
        view = look_at(target_mm, 335.0, float(random.uniform(-180, 180)), float(random.uniform(35, 85)), 0.0)
        poses.append(base_from_support @ view @ camera_from_flange)
    leds = LedModel(seed=seed, flux_spread=0.01, pump_spread_nm=0.0)
    return Scene(job, photographer, job.schedule.bursts[0][0], LookGrid(frame_format), poses, leds)


# -- faults -----------------------------------------------------------------------------------------------


Drawn = tuple[dict[int, list[Any]], dict[int, float], str]
"""Faults by the step of the table at which they happen; unsteady LEDs; expected words of the finding."""


def _moment(random: np.random.Generator, burst: Burst, low: float, high: float) -> int:
    inner = burst.inner
    return int(inner.start + random.uniform(low, high) * len(inner))


def _lit(burst: Burst) -> NDArray[np.int64]:
    return np.flatnonzero(burst.table["led"] != NO_LED)


def _either_way(random: np.random.Generator, low: float, high: float) -> float:
    return float(random.choice([-1.0, 1.0]) * random.uniform(low, high))


def ambient(random: np.random.Generator, burst: Burst) -> Drawn:
    """A lamp of 3 to 50 lux, at any moment before the last marks."""
    lamp = script.RoomLamp(kind="room_lamp", lux=float(random.uniform(3.0, 50.0)))
    return {_moment(random, burst, 0.0, 0.99): [lamp]}, {}, f"{lamp.lux:.0f} lux"


def flicker(random: np.random.Generator, burst: Burst) -> Drawn:
    """A sentinel's LED that flickers by 3 to 15 %."""
    leds = sorted({label.light.led for label in burst.labels if label and isinstance(label.light, Sentinel)})
    rms = float(random.uniform(0.03, 0.15))
    led = int(random.choice(leds))
    return {}, {led: rms}, f"LED {led}, {rms:.1%} rms"


def ageing(random: np.random.Generator, burst: Burst) -> Drawn:
    """Any LED that has lost 40 to 80 % of its light."""
    led = int(random.choice(burst.table["led"][_lit(burst)]))
    loss = float(random.uniform(0.4, 0.8))
    return {0: [script.DimLed(kind="dim_led", led=led, loss=loss)]}, {}, f"LED {led}, -{loss:.0%}"


def drift(random: np.random.Generator, burst: Burst) -> Drawn:
    """A drift of all LEDs that begins in the first half and reaches 2 to 10 % at the end."""
    begin = _moment(random, burst, 0.0, 0.5)
    rest_s = float(burst.table["period_us"][begin:].sum()) * 1e-6
    reached_share = _either_way(random, 0.02, 0.10)
    return {begin: [script.Warming(kind="warming", per_s=reached_share / rest_s)]}, {}, f"{reached_share:+.1%}"


def bump(random: np.random.Generator, burst: Burst) -> Drawn:
    """The object, or the camera, displaced by 0.2 mm along the support or across the line of sight."""
    angle = random.uniform(0.0, 2.0 * np.pi)
    mm = (float(0.2 * np.cos(angle)), float(0.2 * np.sin(angle)), 0.0)
    moved_thing = str(random.choice(["object", "camera"]))
    fault = script.Bump.model_validate({"kind": "bump", "what": moved_thing, "mm": mm})
    return {_moment(random, burst, 0.05, 0.93): [fault]}, {}, f"{moved_thing} 0.2 mm"


def smudge(random: np.random.Generator, burst: Burst) -> Drawn:
    """A smudge that takes 4 to 15 % of the light, anywhere in the middle of the picture."""
    at = (float(random.uniform(0.25, 0.75)), float(random.uniform(0.3, 0.7)))
    fault = script.Smudge(
        kind="smudge",
        at=at,
        radius=float(random.uniform(0.1, 0.25)),
        transmission=1.0 - float(random.uniform(0.04, 0.15)),
    )
    words = f"{fault.transmission:.0%} at {at[0]:.2f}, {at[1]:.2f}"
    return {_moment(random, burst, 0.05, 0.93): [fault]}, {}, words


def exposure_step(random: np.random.Generator, burst: Burst) -> Drawn:
    """A step of all values above black by 2 to 20 %."""
    factor = 1.0 + _either_way(random, 0.02, 0.20)
    fault = script.ExposureStep(kind="exposure_step", factor=factor)
    return {_moment(random, burst, 0.05, 0.93): [fault]}, {}, f"x {factor:.2f}"


def hand(random: np.random.Generator, burst: Burst) -> Drawn:
    """A hand or a cloth in the field for 18 to 60 frames, a little more than from one sentinel to the next."""
    frames = int(random.integers(18, 61))
    fault = script.Hand(
        kind="hand",
        seconds=frames * burst.timing.period_us * 1e-6,
        at=(float(random.uniform(0.15, 0.85)), float(random.uniform(0.25, 0.75))),
        radius=float(random.uniform(0.12, 0.3)),
        brightness=float(random.choice([random.uniform(0.05, 0.4), random.uniform(1.5, 4.0)])),
        sway=float(random.uniform(0.0, 0.05)),
    )
    return {_moment(random, burst, 0.02, 0.8): [fault]}, {}, f"{frames} frames, {fault.brightness:.1f} bright"


Draw = Callable[[np.random.Generator, Burst], Drawn]
KINDS: Sequence[tuple[str, Draw]] = (
    ("ambient light", ambient),
    ("LED", flicker),
    ("drift", drift),
    ("moved", bump),
    ("smudge", smudge),
    ("exposure step", exposure_step),
    ("thing in the field", hand),
    ("LED", ageing),
)


# -- the proof --------------------------------------------------------------------------------------------


def judge_view(
    cell: Scene, random: np.random.Generator, pose: int, draw: Draw | None
) -> tuple[list[Found], str, BurstJudge]:
    """Findings of one view with a fault, or without."""
    faults, unsteady, words = draw(random, cell.burst) if draw else ({}, {}, "")
    judge = judge_of(cell.job, cell.grid, cell.job.schedule.views[0], FirstFrames())
    frames = cell.looks(pose, Disturber(), unsteady, faults)
    return judge.judge(frames, cell.burst.timing.exposure_us), words, judge


def _names_led(found: Found, words: str) -> bool:
    """Tell whether a finding is about the LED with which these words begin."""
    named_leds = {f"LED {getattr(label.light, 'id', None)}" for label in found.labels}
    return named_leds == {words.partition(",")[0]}


def main() -> int:
    """Run the proof; see the module's text."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--faults", type=int, default=50, help="number of views with a fault")
    parser.add_argument("--clean", type=int, default=200, help="number of views without one")
    parser.add_argument("--every", type=int, default=5, help="each N-th LED of the dome is lit")
    parser.add_argument("--seed", type=int, default=1)
    add_smallest(parser, faults=8, clean=2, every=10)
    options = parser.parse_args()
    found_of: Counter[tuple[str, str]] = Counter()
    with tempfile.TemporaryDirectory() as folder:
        cell = scene(Path(folder), options.every, options.seed)
        print(f"a burst has {len(cell.burst.labels)} frames, {cell.burst.is_light().sum()} of them shots")
        alarms = 0
        for number in range(options.clean):
            random = np.random.default_rng([options.seed, 1, number])
            findings, _, _ = judge_view(cell, random, number * VIEWS // max(1, options.clean), None)
            alarms += bool(findings)
            for finding in findings:
                print(f"  false alarm in clean view {number}: {finding.kind}: {finding.words}")
        for number in range(options.faults):
            random = np.random.default_rng([options.seed, 2, number])
            kind, draw = KINDS[number % len(KINDS)]
            findings, words, _ = judge_view(cell, random, number * VIEWS // options.faults, draw)
            names = [finding.kind for finding in findings]
            is_found = kind in names[:1] and (kind != "LED" or _names_led(findings[0], words))
            verdict = "found" if is_found else "named " + names[0] if names else "missed"
            found_of[kind, verdict.split()[0]] += 1
            figures = "; ".join(f"{f.figure:.3g} (limit {f.limit:.3g} {f.unit})" for f in findings[:1])
            print(f"  {kind:<19} {words:<28} {verdict:<26} {figures}")
    print(f"{'fault':<20} views  found  misnamed  missed")
    for kind in dict.fromkeys(kind for kind, _ in KINDS):
        counts = [found_of[kind, verdict] for verdict in ("found", "named", "missed")]
        print(f"{kind:<20} {sum(counts):5d}  {counts[0]:5d}  {counts[1]:8d}  {counts[2]:6d}")
    found = sum(count for (_, verdict), count in found_of.items() if verdict == "found")
    print(
        f"{found} of {options.faults} faults found and named; {alarms} false alarms in {options.clean} clean views"
    )
    is_good = found == options.faults and alarms <= ALLOWED_ALARMS * options.clean
    return 0 if is_good or options.smallest else 1


if __name__ == "__main__":
    sys.exit(main())
