"""The simulated cell of a test: stand-ins at the other ends of real wires, and their state as an onlooker sees
it."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from coupole.clock import Clock
from coupole.plan import rig as rig_models
from coupole.plan.cell import read_cell
from coupole.plan.registry import WORLD, load_class, settings_class
from coupole.preflight.job import read_job
from coupole.preflight.simulated_world import frozen, world_config
from coupole.scripting.plans import Rig

_UNHURRIED_S = 0.5
"""A motion of a simulated arm ends if nobody looks at the arm for this time, s. It is long because tests run on
busy machines."""


@dataclass(frozen=True)
class SeenFromOutside:
    """The state of a cell at one moment, as an onlooker sees it."""

    shining: tuple[int, ...]
    """Numbers of the LEDs that shine."""
    panels: tuple[int, ...]
    """Numbers of the panels that shine, from 1."""
    arm_moves: bool
    """True while an axis turns."""
    joints_deg: tuple[float, ...]
    """[6] true angles of the axes."""
    camera_is_armed: bool
    """True if trigger edges make the camera expose frames."""

    @property
    def is_safe(self) -> bool:
        """True if nothing shines, the arm stands and the camera is disarmed."""
        return not (self.shining or self.panels or self.arm_moves or self.camera_is_armed)


@dataclass(frozen=True)
class SimulatedCell:
    """A running simulated cell. Its clients may disconnect; it ends with the test."""

    rig: Path
    """A rig file that names the cell's devices, for `coupole.open_cell`, `coupole.acquire(plan, rig=...)` and the
    commands. Runs, ledgers and the arm's faults are stored in a folder of the test."""
    endpoints: Mapping[str, Any]
    """Address of each stand-in, as `coupole sim` prints it: `ledbox` has a serial `port`, `robot` and `camera`
    have network addresses."""
    clock: Clock
    """The cell's clock, for drivers."""
    world: Any
    """Control connection of the simulated world (`sim.world.client:World`)."""

    def look(self) -> SeenFromOutside:
        """Return the present state of the cell, as an onlooker sees it."""
        state = self.world.ask("state")
        return SeenFromOutside(
            tuple(state["shining"]),
            tuple(state["panels"]),
            state["arm_moving"],
            tuple(state["joints_deg"]),
            state["camera_armed"],
        )

    def light_given_s(self) -> dict[int, float]:
        """Return how long each LED has shone since the cell began, s."""
        return {int(led): seconds for led, seconds in self.world.ask("light")["leds_s"].items()}

    def fault(self, kind: str, **how: Any) -> None:
        """Inject a fault of docs/reference/rig.md, such as `fault("mute_box", at_s=0.0)`. Raises ValueError if
        there is no such fault, or if these stand-ins cannot have it."""
        if error := self.world.ask("fault", fault={"kind": kind, **how}).get("error"):
            raise ValueError(error)


@contextmanager
def simulated_cell(
    folder: Path, rig: str | Path = "sim", *, plan: str | Path | None = None, speed: float = 1.0
) -> Iterator[SimulatedCell]:
    """Start the stand-ins of a rig at `speed` times real time; their process ends with the context.

    The object of `plan` lies on the support. `folder` takes the rig file and all files of runs. Raises InputError
    if rig or plan are wrong, DeviceError if the cell does not start.
    """
    job = read_job(Path(plan), Path(rig)) if plan is not None else None
    cell = job.cell if job is not None else read_cell(Path(rig))
    section = cell.rig.world
    config = world_config(cell, job, cell.rig.sensor, speed=speed)
    with frozen(config, cell.files) as frozen_config:
        world = load_class(section.driver if section else WORLD).start(frozen_config)
    try:
        endpoints = folder / "endpoints.json"
        endpoints.write_text(json.dumps(world.endpoints) + "\n", encoding="utf-8")
        path = _joining(Rig.read(rig), folder, endpoints).write(folder / "rig.yaml")
        yield SimulatedCell(path, world.endpoints, world.clock, world)
    finally:
        world.close()


def _joining(rig: Rig, folder: Path, endpoints: Path) -> Rig:
    """Return the rig with its devices in the running cell, and with its own folders."""
    section = rig.world or rig_models.WorldSection()
    robot = rig.robot
    if "attention_s" in settings_class(robot.driver).model_fields:
        robot = robot.model_copy(update={"settings": {"attention_s": _UNHURRIED_S, **robot.settings}})
    return rig.model_copy(
        update={
            "world": section.model_copy(update={"serves": "always", "join": endpoints}),
            "robot": robot,
            "storage": rig.storage.model_copy(update={"folder": folder / "runs"}),
            "ledger": folder / "ledger",
            "controllers": folder / "controllers",
        }
    )
