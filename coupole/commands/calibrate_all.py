"""`coupole calibrate all`: every calibration of a cell, from nothing, in their order."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from coupole.commands import calibrate_geometry, calibrate_lens, calibrate_light
from coupole.commands.common import JsonOption, fail
from coupole.errors import CoupoleError, InputError, Interrupted

if TYPE_CHECKING:
    from rich.console import Console

BOARD = """\
schema_version: 1
kind: charuco
corners: [11, 8]
square_mm: 16.0
marker_mm: 9.6
dictionary: DICT_5X5_250
"""
TILE = """\
schema_version: 1
side_mm: 50.0
support_from_tile: {translation_mm: [0, 0, 10]}
"""


@dataclass(frozen=True)
class Step:
    """One acquisition and the records that are made from it."""

    name: str
    """Of the plan, and of its template."""
    stands: str
    """What must be on the support, for the operator."""
    things: tuple[Mapping[str, Any], ...]
    """The same for a simulated cell, which sets it up itself (`world.settings.things`)."""
    records: tuple[str, ...]


STEPS = (
    Step("darks", "nothing; close the dome, no light of the room", (), ("dark",)),
    Step("response", "a grey card", ({"kind": "grey_card"},), ("response",)),
    Step("flat-field", "nothing", (), ("flat-field",)),
    Step(
        "charuco",
        "the ChArUco board at the centre",
        ({"kind": "charuco_board", "square_mm": 16.0, "marker_mm": 9.6},),
        ("camera", "hand-eye"),
    ),
    Step("leds", "nothing", (), ("leds",)),
    Step("spectralon", "the white tile at the centre", ({"kind": "spectralon_tile"},), ("led-power",)),
)


def calibrate_all(
    rig: Annotated[Path, typer.Option("--rig", help="The rig (YAML).")] = Path("configs/rigs/sim-imperfect.yaml"),
    out: Annotated[Path, typer.Option("--out", help="Folder for plans, runs, records and reports.")] = Path(
        "calibrations"
    ),
    only: Annotated[list[str] | None, typer.Option("--only", help="This step alone; again for more.")] = None,
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask before each step of a real cell.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Dark frames, response, flat field, lens and hand-eye, LEDs and their power: acquire and calibrate each.

    What has a record in the folder already is left as it is, and a run that was cut off is gone on with: call it
    again to finish. For a real cell it says what must stand on the support, and waits.
    """
    from coupole.console import make_console
    from coupole.job import read_cell

    console = make_console(quiet=as_json)
    known = [step.name for step in STEPS]
    if unknown := [name for name in only or [] if name not in known]:
        raise InputError(f"--only {unknown[0]}: expected one of {', '.join(known)}")
    simulated = read_cell(rig).rig.world is not None
    campaign = Campaign(rig, out, simulated=simulated, ask=not yes and not simulated, console=console)
    try:
        for step in STEPS:
            if not only or step.name in only:
                campaign.do(step)
    except CoupoleError as error:
        fail(error, as_json=as_json, found={"records": campaign.found()})
        raise
    if as_json:
        print(json.dumps({"records": campaign.found()}))
    else:
        for kind, record in campaign.found().items():
            console.print(f"[green]{kind}[/]: {record}")


class Campaign:
    """The folder of a campaign: `plans/`, `rigs/`, `runs/`, and the records with their reports."""

    def __init__(self, rig: Path, out: Path, *, simulated: bool, ask: bool, console: Console) -> None:
        self._rig, self._out, self._console = rig.resolve(), out.resolve(), console
        self._simulated, self._ask = simulated, ask
        for folder in ("plans", "rigs", "runs"):
            (self._out / folder).mkdir(parents=True, exist_ok=True)
        (self._out / "board.yaml").write_text(BOARD, encoding="utf-8")
        (self._out / "tile.yaml").write_text(TILE, encoding="utf-8")

    def found(self) -> dict[str, str]:
        """Records that stand, by kind."""
        kinds = [kind for step in STEPS for kind in step.records]
        return {kind: str(self._record(kind)) for kind in kinds if self._record(kind).is_file()}

    def do(self, step: Step) -> None:
        """Acquire what is missing of a step, and calibrate what has no record yet."""
        todo = [kind for kind in step.records if not self._record(kind).is_file()]
        if not todo:
            self._console.print(f"{step.name}: its records stand already")
            return
        run = self._acquire(step)
        for kind in todo:
            self._console.rule(f"calibrate {kind}")
            self._calibrations()[kind](run)

    def _acquire(self, step: Step) -> Path:
        """The step's run, complete."""
        from coupole.job import read_job
        from coupole.run import Run, status
        from coupole.session import acquire_plan

        plan = self._plan(step)
        begun = sorted((self._out / "runs").glob(f"*-{step.name}"))
        resumed = begun[-1] if begun and (begun[-1] / "run.json").is_file() else None
        if resumed is not None and not status(Run(resumed)).missing:
            return resumed
        self._console.rule(f"acquire {step.name}")
        if self._ask:
            self._console.print(f"On the support must stand: [bold]{step.stands}[/].")
            if not typer.confirm("Ready?", default=True):
                raise Interrupted("stopped by the operator; call it again to go on")
        found: dict[str, Any] = {}
        job = read_job(plan)
        acquire_plan(job, self._console, parent=self._out / "runs", resume=resumed, confirm=self._ask, found=found)
        return Path(found["run"])

    def _plan(self, step: Step) -> Path:
        """The step's plan; one that stands there, and may have been changed by hand, is kept."""
        from coupole.calibration.led_plan import led_plan
        from coupole.job import read_cell
        from coupole.templates import LEDS, TEMPLATES

        path = self._out / "plans" / f"{step.name}.yaml"
        if path.exists():
            return path
        rig = self._rig_of(step)
        if step.name == LEDS:
            with self._console.status("reading the rig") as status:
                text = led_plan(read_cell(rig), name=step.name, rig=str(rig), tell=status.update)
        else:
            text = TEMPLATES[step.name].format(name=step.name, rig=rig)
        path.write_text(text, encoding="utf-8")
        return path

    def _rig_of(self, step: Step) -> Path:
        """The rig; of a simulated cell a copy with the step's things on the support."""
        if not self._simulated:
            return self._rig
        from ruamel.yaml import YAML

        yaml = YAML()
        content = yaml.load(self._rig.read_text(encoding="utf-8"))
        folder = self._rig.parent
        content["dome"]["leds"] = str((folder / content["dome"]["leds"]).resolve())
        content["storage"]["folder"] = str(self._out / "runs")
        settings = content["world"].setdefault("settings", {})
        settings["things"] = [*settings.get("things", ()), *(dict(thing) for thing in step.things)]
        path = self._out / "rigs" / f"{step.name}.yaml"
        with path.open("w", encoding="utf-8") as file:
            yaml.dump(content, file)
        return path

    def _record(self, kind: str) -> Path:
        return self._out / f"{kind}.yaml"

    def _calibrations(self) -> dict[str, Callable[[Path], None]]:
        """How each record is made from a run, with the records before it."""
        record, out = self._record, self._out
        dark, response, flat = record("dark"), record("response"), record("flat-field")
        camera, hand_eye = record("camera"), record("hand-eye")
        board = self._out / "board.yaml"
        return {
            "dark": lambda run: calibrate_light.dark([run], name="dark", out=out),
            "response": lambda run: calibrate_light.response([run], dark_record=dark, name="response", out=out),
            "flat-field": lambda run: calibrate_light.flat_field(
                [run], dark_record=dark, response_record=response, name="flat-field", out=out
            ),
            "camera": lambda run: calibrate_lens.camera([run], board=board, name="camera", out=out),
            "hand-eye": lambda run: calibrate_lens.hand_eye(
                [run], board=board, camera_record=camera, rig=self._rig, name="hand-eye", out=out
            ),
            "leds": lambda run: calibrate_geometry.leds(
                [run], hand_eye=hand_eye, camera=camera, rig=self._rig, name="leds", out=out
            ),
            "led-power": lambda run: calibrate_light.led_power(
                [run],
                tile=self._out / "tile.yaml",
                rig=self._rig,
                camera=camera,
                dark_record=dark,
                response_record=response,
                flat=flat,
                name="led-power",
                out=out,
            ),
        }
