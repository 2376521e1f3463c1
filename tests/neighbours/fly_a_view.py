"""What tests/neighbours/test_bluesky.py runs as a process: bluesky's RunEngine flies one view, Tiled keeps it.

Arguments: rig, folder. Prints one JSON document of what went out and what came back.
"""

from __future__ import annotations

import json
import math
import sys
from pathlib import Path
from typing import Any

import numpy as np
from bluesky import RunEngine
from bluesky import preprocessors as bpp
from bluesky.callbacks.tiled_writer import TiledWriter
from bluesky.utils import FailedStatus
from ophyd_async.core import init_devices
from tiled.catalog import in_memory
from tiled.client import Context, from_context
from tiled.server.app import build_app

import coupole
from coupole.neighbours.bluesky import DomeCell, take_view

LEDS = [420, 0, 20]
FACTS = ("led", "exposure_us", "is_dark", "xxh3", "row", "proof", "a3_deg", "camera_z_mm", "led_x_mm")


def compared(tiled_run: Any, run: coupole.Run) -> dict[str, Any]:
    """Whether each frame and its facts are the run's."""
    table, pixels = tiled_run["top"].read(), tiled_run["top_pixels"]["pixels"]
    rows = {str(shot): place for place, shot in enumerate(table["shot"].values)}
    view = run["top"]
    wrong = []
    for frame in view.values():
        place = rows.pop(frame.shot)
        facts = {name: table[name].values[place] for name in FACTS}
        expected = {
            "led": -1 if frame.led is None else frame.led,
            "exposure_us": frame.exposure_us,
            "is_dark": frame.is_dark,
            "xxh3": frame.xxh3,
            "row": frame.slot,
            "proof": frame.proof,
            "a3_deg": frame.joints_deg[2],
            "camera_z_mm": frame.base_from_camera[2, 3],
            "led_x_mm": 1.0 if frame.led_position_mm is None else frame.led_position_mm[0],
        }
        if frame.led_position_mm is None and math.isnan(facts["led_x_mm"]):
            facts["led_x_mm"] = 1.0
        if facts != expected or not np.array_equal(pixels[frame.slot], frame.pixels):
            wrong.append(frame.shot)
    return {"frames": len(view), "wrong": wrong, "beside": list(rows), "shape": list(pixels.shape)}


def main() -> None:
    rig, folder = Path(sys.argv[1]), Path(sys.argv[2])
    engine = RunEngine({})
    documents: list[tuple[str, dict[str, Any]]] = []
    with init_devices():
        cell = DomeCell("demo-short", rig=rig, output=folder / "runs")

    @bpp.run_decorator(md={"purpose": "one view"})
    def one_view() -> Any:
        yield from take_view(cell, "top", leds=LEDS, exposure_us=4000)

    @bpp.run_decorator()
    def a_view_that_is_not_there() -> Any:
        yield from take_view(cell, "bottom")

    storage = [str(folder / "tiled"), f"duckdb:///{folder}/tables.duckdb"]
    catalog = in_memory(writable_storage=storage, readable_storage=[str(folder / "runs")])
    with Context.from_app(build_app(catalog)) as context:
        client = from_context(context)
        tokens = [engine.subscribe(TiledWriter(client)), engine.subscribe(lambda *pair: documents.append(pair))]
        (uid,) = engine(one_view())
        for token in tokens:
            engine.unsubscribe(token)
        (run_folder,) = (folder / "runs").iterdir()
        with coupole.open_run(run_folder) as run:
            found = compared(client[uid], run)
            found["leds"] = [run["top"][label].led for label in run["top"].shots]
            found["proof"] = run.proof
        found["documents"] = [name for name, _ in documents]
        found["start"] = client[uid].metadata["start"]["purpose"]
        found["stop"] = client[uid].metadata["stop"]["exit_status"]
        (descriptor,) = (doc for name, doc in documents if name == "descriptor" and doc["name"] == "top_pixels")
        found["configuration"] = descriptor["configuration"]["cell"]["data"]
        found["run"] = str(run_folder)
    try:
        engine(a_view_that_is_not_there())
    except FailedStatus as error:
        found["refused"] = str(error.__cause__)
    print(json.dumps(found, default=lambda value: getattr(value, "tolist", lambda: str(value))()))


if __name__ == "__main__":
    main()
