"""Computes all inputs of a view's samples that do not depend on its frames, while the frames still arrive."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from uuid import uuid4

import numpy as np

from coupole.plan.shot_id import Led
from coupole.reflectance.extraction.extraction import find_codes_ahead, surface_of
from coupole.reflectance.light_paths import NOTHING_AHEAD, Ahead, paths_of
from coupole.reflectance.run_job import RunRequest, forget, prepare_run


def look_ahead(
    run: Path, view_name: str, ahead: Ahead = NOTHING_AHEAD, is_wanted: Callable[[], bool] = lambda: True
) -> None:
    """Compute all inputs of a view's samples that do not depend on its frames, while the frames still arrive. The
    view must have a frame already. The inputs are the surface that it sees, the places where the object hides
    LEDs, and the paths of light, which `ahead` keeps. It ends early if `is_wanted` says so. Raises as
    `reflectance_of`.
    """
    request = RunRequest((run,))
    try:
        measured_run, geometry, _ = prepare_run(uuid4().hex, run.resolve(), request.sources)
        view = next((view for view in measured_run.views if view.name == view_name), None)
        if view is None:
            return
        surface = surface_of(measured_run, geometry, view, len(os.sched_getaffinity(0)))
        shots = measured_run.run.expected_shots()
        lit = {shot.light.id for shot in shots if shot.view == view_name and isinstance(shot.light, Led)}
        leds = np.intersect1d(np.array(sorted(lit), np.int64), measured_run.leds.ids)
        find_codes_ahead(measured_run, geometry, view, leds, is_wanted)
        if measured_run.direct_light_alone or not is_wanted():
            return
        paths = paths_of(
            measured_run.corners_mm.astype(np.float32),
            measured_run.base_from_support,
            support_reflects=request.support_reflectance > 0,
            paper=measured_run.emission == "paper",
            triangles_of_views=len(surface.triangles) * measured_run.run.expected_views,
            ahead=ahead,
        )
        for compute in (
            paths.form_factors,
            lambda: paths.direct(*measured_run.leds.of(leds)),
            lambda: paths.gathers(surface.triangles),
        ):
            if is_wanted():
                compute()
    finally:
        forget()
