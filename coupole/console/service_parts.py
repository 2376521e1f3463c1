"""Parts of a console that its interface and its screens use."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from coupole.console.cell.acquisitions import Acquisitions
from coupole.console.cell.bench_keeper import Bench
from coupole.console.cell.calibration_status import CalibrationStatus
from coupole.console.people.accounts import Accounts
from coupole.console.people.audit import Audit
from coupole.console.people.sessions import Control, Session, Sessions
from coupole.console.people.still_wanted import LoopWatch
from coupole.console.plans.drafts import Desk
from coupole.console.plans.entering import Entering
from coupole.console.plans.object_files import ObjectFiles
from coupole.console.plans.plan_files import PlanFiles
from coupole.console.plans.plan_queue import PlanQueue
from coupole.console.processes.tasks import Tasks
from coupole.console.routes.messages import StateNow
from coupole.console.runs.frame_sheets import FrameSheets
from coupole.console.runs.run_files import RunFiles
from coupole.console.runs.run_watch import RunWatch
from coupole.console.upkeep.support_bundle import SupportBundles
from coupole.plan.cell import Cell


@dataclass(frozen=True)
class Service:
    """The parts of one cell's console."""

    cell: Cell
    folder: Path
    """Folder of the console's own state: accounts, log, queue."""
    plans: Path
    """Folder of the plans that may be entered."""
    accounts: Accounts
    sessions: Sessions
    control: Control
    loop_watch: LoopWatch
    audit: Audit
    queue: PlanQueue
    acquisitions: Acquisitions
    plan_files: PlanFiles
    desk: Desk
    """Checks and draws plans that are being written."""
    runs: RunFiles
    sheets: FrameSheets
    calibrations: CalibrationStatus
    bundles: SupportBundles
    watch: RunWatch
    """Watch over the run at work."""
    objects: ObjectFiles
    tasks: Tasks
    bench: Bench
    """Holds the devices while there is no run."""
    state: Callable[[], StateNow]
    """Function that returns the present state of the cell."""
    newest: Callable[[], StateNow]
    """Function that returns the state of a moment ago, without delay."""
    entering: Entering
    origins: frozenset[str]
    """Origins of this service's own pages."""
    cookie: str
    """Name of the cookie of sessions; no other console of this machine uses it."""
    command_line: Session
    """Session of the service's own user, on this machine."""
