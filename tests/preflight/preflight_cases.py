"""Plans of the simulated cell, checked without paths or disk: what tests of preflight begin with."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from places import REPO

from coupole.motion.itinerary import bodies_of, plan_itinerary
from coupole.plan.led_table import LedTable, read_led_table
from coupole.plan.plan import Plan
from coupole.plan.rig import Rig
from coupole.plan.rig_devices import device_times
from coupole.plan.schedule import Schedule, build_schedule
from coupole.plan.yamlfile import read_document
from coupole.preflight.preflight import Course, ObjectLight, Report, StorageFacts, check

RIG, _ = read_document(REPO / "configs/rigs/sim.yaml").problems(Rig)
DOME = read_led_table(REPO / "configs/domes/coupole.csv")
ROOMY = StorageFacts(free_bytes=10**15, write_bytes_s=10e9)
CENTRE = np.zeros((1, 3))
NO_OBJECT = np.zeros((0, 3, 3))
TOP = {"kind": "look_at", "name": "top", "target_mm": [0, 0, 30], "distance_mm": 335, "azimuth_deg": -90}
PARK = {"kind": "joints", "name": "park", "joints_deg": [0, -170, 150, 0, -70, 0]}


def plan_of(**changes: Any) -> Plan:
    asked = {
        "schema_version": 1,
        "name": "test",
        "rig": "rig.yaml",
        "views": [{**TOP, "elevation_deg": 80}],
        "lights": {"kind": "all"},
        "exposure": {"kind": "fixed", "exposure_us": 8000},
    }
    return Plan.model_validate(asked | changes)


def rig_of(**changes: Any) -> Rig:
    """The simulated cell with some of its sections changed."""
    assert RIG is not None
    return Rig.model_validate({**RIG.model_dump(), **changes})


def schedule_of(plan: Plan, rig: Rig, leds: LedTable) -> Schedule:
    return build_schedule(plan, leds, rig.support.base_from_support.matrix(), device_times(rig))


def checked(
    plan: Plan,
    rig: Rig | None = None,
    leds: LedTable = DOME,
    storage: StorageFacts = ROOMY,
    points: np.ndarray[Any, Any] = CENTRE,
    start_joints_deg: Sequence[float] | None = None,
    dose_before_lux_h: float = 0.0,
) -> Report:
    rig = rig or rig_of()
    schedule = schedule_of(plan, rig, leds)
    bodies = bodies_of(rig, DOME, NO_OBJECT)
    start_deg = start_joints_deg or rig.motion.home_joints_deg
    itinerary = plan_itinerary(schedule.views, rig, bodies, start_deg, plan.order)
    return check(plan, rig, leds, Course(schedule, itinerary), storage, ObjectLight(points, dose_before_lux_h))


def only_refusal(report: Report) -> str:
    assert len(report.refusals) == 1, report.refusals
    return report.refusals[0]


def sphere(distance_mm: float = 1000.0, flux_lm: float = 1800.0, count: int = 1080) -> LedTable:
    """LEDs on a half sphere about the support's centre, all facing it."""
    assert RIG is not None
    rng = np.random.default_rng(1)
    outward = rng.normal(size=(count, 3))
    outward[:, 2] = np.abs(outward[:, 2])
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    base_from_support = RIG.support.base_from_support.matrix()
    positions = outward @ base_from_support[:3, :3].T * distance_mm + base_from_support[:3, 3]
    index = np.arange(count)
    return LedTable(index, index // 6, positions, -outward @ base_from_support[:3, :3].T, np.full(count, flux_lm))


TEN_MS_ON = {"kind": "fixed", "exposure_us": 10_000 - 1_000 - 200}
"""An exposure whose LEDs are on for 10 ms: rise and margin stand around it."""
