"""A campaign of calibrations: its steps in order, and the folder with their inputs and results."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from coupole.calibration.campaign_steps import OBJECT, STEPS, Step
from coupole.commands import calibrate_geometry, calibrate_lens, calibrate_light
from coupole.commands.simulated_support import BOARD, CERTIFICATE_OF_SIMULATED_TILE, TILE, with_things
from coupole.errors import CalibrationRefused, Interrupted
from coupole.viewing.questions import ask

if TYPE_CHECKING:
    from rich.console import Console


@dataclass(frozen=True)
class Repeatability:
    """Noise of the robot from pose to pose, as stated."""

    mm: float
    deg: float


@dataclass(frozen=True)
class Operator:
    """The person who makes the campaign."""

    console: Console
    is_asked: bool
    """True if a person is asked before each step. Otherwise all that a step needs is on the support."""


class Campaign:
    """The folder of a campaign: `plans/`, `rigs/`, `runs/`, and the records with their reports.

    Existing plans and descriptions of board and tile are kept, so that they can be edited.
    """

    def __init__(
        self,
        rig: Path,
        out: Path,
        scan: Path | None,
        robot_noise: Repeatability,
        operator: Operator,
        *,
        is_simulated: bool,
        valid_days: int | None = None,
    ) -> None:
        self._rig, self._out, self._console = rig.resolve(), out.resolve(), operator.console
        self._days = {} if valid_days is None else {"valid_days": valid_days}
        self._given_scan, self._stated = scan, robot_noise
        self._simulated, self._operator = is_simulated, operator
        for folder in ("plans", "rigs", "runs"):
            (self._out / folder).mkdir(parents=True, exist_ok=True)
        tile = TILE + (CERTIFICATE_OF_SIMULATED_TILE if is_simulated else "")
        for name, text in (("board.yaml", BOARD), ("tile.yaml", tile)):
            if not (self._out / name).exists():
                (self._out / name).write_text(text, encoding="utf-8")

    def record_paths(self) -> dict[str, str]:
        """Existing records, by kind."""
        kinds = [kind for step in STEPS for kind in step.records]
        return {kind: str(self._record(kind)) for kind in kinds if self._record(kind).is_file()}

    def do_all(self, names: Collection[str]) -> None:
        """Do the steps with these names, in the order of `STEPS`."""
        for step in STEPS:
            if step.name in names:
                self.do(step)

    def do(self, step: Step) -> None:
        """Acquire the missing frames of a step, and make its missing records."""
        self._refuse_missed(step)
        todo = [kind for kind in step.records if not self._record(kind).is_file()]
        if not todo:
            self._console.print(f"{step.name}: its records exist already")
            return
        run = self._acquire(step)
        for kind in todo:
            self._console.rule(f"calibrate {kind}")
            self._calibrations()[kind](run)

    def _refuse_missed(self, step: Step) -> None:
        """Raise CalibrationRefused if a record of an earlier call exceeds its limits, because later steps must not
        use it."""
        from coupole.calibration.record import read_record

        for kind in step.records:
            path = self._record(kind)
            excesses = [limit for limit in read_record(path).limits if not limit.is_met] if path.is_file() else []
            if excesses:
                raise CalibrationRefused(
                    [
                        *(
                            f"{path}: not accepted: {excess.what} is {excess.found:.3g} {excess.unit}"
                            for excess in excesses
                        ),
                        f"Read {path.with_suffix('.html')}; remove the cause, or calibrate by hand with --limit "
                        f"or --accept-faults; then remove {path.stem}.*, and call this again",
                    ]
                )

    def _acquire(self, step: Step) -> Path:
        """Return the complete run of a step; acquire or resume it first if it is not complete."""
        from coupole.acquisition.session import SessionRequest, acquire_plan
        from coupole.preflight.job import read_job
        from coupole.storage.run_status import is_complete, newest_run

        plan = self._plan(step)
        resumed_run = newest_run(self._out / "runs", step.name, plan, self._console.print)
        if resumed_run is not None and is_complete(resumed_run):
            return resumed_run
        self._console.rule(f"acquire {step.name}")
        if self._operator.is_asked:
            self._console.print(f"Place on the support: [bold]{step.stands}[/].")
            if not ask("Ready?", default=True):
                raise Interrupted("stopped by the operator; give the command again to continue")
        summary: dict[str, Any] = {}
        job = read_job(plan)
        request = SessionRequest(self._out / "runs", resumed_run, confirm=self._operator.is_asked)
        acquire_plan(job, self._console, request, summary)
        return Path(summary["run"])

    def _plan(self, step: Step) -> Path:
        """Return the step's plan. An existing plan is kept, because the operator may have edited it."""
        from coupole.calibration.leds.led_plan import led_plan
        from coupole.plan.cell import read_cell
        from coupole.plan.templates import LEDS, TEMPLATES

        path, rig = self._out / "plans" / f"{step.name}.yaml", self._rig_of(step)
        if path.exists():
            return path
        from coupole.storage.durable import write_synced

        if step.name == LEDS:
            with self._console.status("reading the rig") as status:
                text = led_plan(read_cell(rig), name=step.name, rig=str(rig), tell=status.update)
        else:
            text = TEMPLATES[step.name].format(name=step.name, rig=rig)
        write_synced(path, text)
        return path

    def _rig_of(self, step: Step) -> Path:
        """Return the rig. For a simulated cell, return a copy with the step's things on the support; an existing
        copy is kept."""
        path = self._out / "rigs" / f"{step.name}.yaml"
        if not self._simulated:
            return self._rig
        if path.exists():
            return path
        with_things(self._rig, step.things, path, self._out / "runs")
        return path

    def _scan(self) -> Path:
        """Return the object's scan. The scanner of a simulated cell makes one, which is imported like any
        other."""
        from coupole.plan.registry import SCANNER_EXPORT, load_class
        from coupole.viewing.scan_sheet import import_scan

        if self._given_scan is not None:
            return self._given_scan
        folder = self._out / "scan"
        if not folder.exists():
            export: Any = load_class(SCANNER_EXPORT)
            mesh, targets = export(OBJECT, self._out / "scanner")
            with self._console.status("importing the scan") as status:
                import_scan(
                    mesh,
                    targets,
                    folder,
                    unit="mm",
                    targets_unit=None,
                    accept_defects=False,
                    progress=status.update,
                )
        return folder

    def _record(self, kind: str) -> Path:
        return self._out / f"{kind}.yaml"

    def _calibrations(self) -> dict[str, Callable[[Path], None]]:
        """Return, for each kind, the function that makes its record from a run and from the earlier records."""
        record, out = self._record, self._out
        dark, response, flat = record("dark"), record("response"), record("flat-field")
        camera, hand_eye = record("camera"), record("hand-eye")
        board, days = self._out / "board.yaml", self._days
        repeatability = {"repeatability_mm": self._stated.mm, "repeatability_deg": self._stated.deg}
        return {
            "dark": lambda run: calibrate_light.dark([run], name="dark", out=out, **days),
            "response": lambda run: calibrate_light.response(
                [run], dark_record=dark, name="response", out=out, **days
            ),
            "flat-field": lambda run: calibrate_light.flat_field(
                [run], dark_record=dark, response_record=response, name="flat-field", out=out
            ),
            "camera": lambda run: calibrate_lens.camera([run], board=board, name="camera", out=out, **days),
            "hand-eye": lambda run: calibrate_lens.hand_eye(
                [run],
                board=board,
                rig=self._rig,
                **repeatability,
                name="hand-eye",
                out=out,
                **days,
            ),
            "leds": lambda run: calibrate_geometry.leds(
                [run],
                hand_eye=hand_eye,
                camera=camera,
                rig=self._rig,
                **repeatability,
                name="leds",
                out=out,
                **days,
            ),
            "led-power": lambda run: calibrate_light.led_power(
                [run],
                tile=self._out / "tile.yaml",
                rig=self._rig,
                leds=record("leds") if record("leds").is_file() else None,
                hand_eye=hand_eye,
                camera=camera,
                dark_record=dark,
                response_record=response,
                flat=flat,
                name="led-power",
                out=out,
                **days,
            ),
            "mesh": lambda run: calibrate_geometry.mesh(
                [run],
                scan=self._scan(),
                hand_eye=hand_eye,
                rig=self._rig,
                **repeatability,
                name="mesh",
                out=out,
                **days,
            ),
        }
