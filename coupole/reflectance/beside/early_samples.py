"""Samples of some frames of a view that still arrives, to look at. The samples are not part of the result."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from uuid import uuid4

from coupole.reflectance.block_work import Said
from coupole.reflectance.extraction.extraction import extract_view
from coupole.reflectance.result_folder import complete
from coupole.reflectance.run_job import RunRequest, forget, prepare_run
from coupole.reflectance.run_result import OBJECT
from coupole.reflectance.run_result_files import write_object
from coupole.storage.durable import make_folder


def extract_early(run: Path, view_name: str, folder: Path, most_leds: int, say: Said) -> int:
    """Write the samples of a view to a folder of their own, in the form of a result, from at most `most_leds` of
    the LEDs whose frames have arrived. Return the number of the view's frames under LEDs that have arrived; 0 if
    there is none, and nothing is written. An error that `say` raises ends it. Raises as `reflectance_of`."""
    request = RunRequest((run,))
    try:
        measured_run, geometry, radiometry = prepare_run(uuid4().hex, run.resolve(), request.sources)
        view = next((view for view in measured_run.views if view.name == view_name), None)
        if view is None:
            return 0
        leds = list(view.by_led)[:: -(-len(view.by_led) // most_leds)]
        some_frames = tuple(frame for led in leds for frame in view.by_led[led])
        make_folder(folder / "samples")
        write = partial(
            write_object,
            corners_mm=measured_run.corners_mm,
            base_from_support=measured_run.base_from_support,
        )
        complete(folder / OBJECT, write)
        path = folder / "samples" / f"{view_name}.h5"
        extract_view(measured_run, geometry, radiometry, replace(view, frames=some_frames), path, say)
        return sum(map(len, view.by_led.values()))
    finally:
        forget()
