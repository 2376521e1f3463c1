"""What is sent to the console and told by it, version 1."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from coupole.console.plans.plan_queue import Entry

Text = Annotated[str, Field(max_length=2000)]


MOST_LUX_H = 1e9
"""A hundred thousand years in a museum at 50 lux are half of it; more is a slip of the finger."""


class Asked(BaseModel):
    """Unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class SignIn(Asked):
    """A name and a password, or the token of the first start."""

    name: Text = ""
    """Of an account."""
    password: Text = ""
    """Of the account."""
    token: Text = ""
    """Printed at a start without an engineer's account; an engineer's, once, on the same machine."""
    script: bool = False
    """The session is returned in `session`, to be sent as a bearer, in place of a cookie."""


class NewEntry(Asked):
    """A plan, a run to be resumed, or a hold."""

    plan: Text = ""
    """File of the plan, relative to the folder of plans."""
    resume: Text = ""
    """Folder of the run to be resumed, relative to the cell's storage folder."""
    hold: Text = ""
    """What is to be done before the queue goes on."""
    before: Text = ""
    """Id of the waiting entry before which it comes; empty: at the end."""
    now: bool = False
    """Begin at once, with preflight only then; refused if something runs, waits or has the cell."""
    output: Text = ""
    """Folder for the run, if not the rig's; for the command line."""
    with_mesh: bool = False
    """Copy the mesh into the run even if it is large; for the command line."""


class Move(Asked):
    """A place in the queue."""

    before: Text = ""
    """Id of the waiting entry before which it comes; empty: at the end."""


class Lease(Asked):
    """What the cell is wanted for."""

    what: Annotated[str, Field(min_length=1, max_length=200)]
    """In words."""


class Light(Asked):
    """Light that an object was given elsewhere."""

    dose_lux_h: Annotated[float, Field(ge=0, le=MOST_LUX_H, allow_inf_nan=False, strict=True)]
    """In lux hours."""
    note: Annotated[str, Field(min_length=1, max_length=2000)]
    """What that light was."""


class Budget(Asked):
    """What an object may receive in its life."""

    dose_lux_h: Annotated[float, Field(ge=0, le=MOST_LUX_H, allow_inf_nan=False, strict=True)]
    """In lux hours."""
    name: Annotated[str, Field(max_length=200)] = ""
    """Whose word it is; empty: of who asks."""
    reason: Annotated[str, Field(max_length=2000)] = ""
    """Why it is this."""


class Warn(Asked):
    """When an object's ledger warns."""

    above_lux_h: Annotated[float, Field(ge=0, le=MOST_LUX_H, allow_inf_nan=False, strict=True)] | None
    """Of a total above this; null: of none."""


class EntryNow(Entry):
    """An entry of the queue at this moment."""

    expected_begin: str | None = None
    """UTC; null if it has ended, if a person decides (a hold before it, a queue that is halted), or if it is not
    known."""
    expected_end: str | None = None
    """Likewise."""


class Output(BaseModel):
    """What an entry's process has told."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    entry: Entry
    """As it is."""
    said: str
    """The last 64 KiB of what it printed."""
    figures: dict[str, Any]
    """As of `coupole acquire --json`; empty until it has ended."""


class NewAccount(Asked):
    """Of a person."""

    name: Text
    """With which they sign in."""
    password: Text
    """With at least ten characters."""
    role: Literal["observer", "operator", "engineer"]
    """What they may do."""


class Hand(Asked):
    """Control, given to who asked for it."""

    to: Text = ""
    """Who; empty: nobody."""


class StateNow(BaseModel):
    """The cell at this moment."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    state: Literal[
        "idle", "starting", "running", "pausing", "paused", "stopping", "concluding", "halted", "silent"
    ]
    """`halted`: the queue waits for a person; `starting`: a plan is checked, and devices are opened; `concluding`:
    devices are closed, the report is made; `silent`: the run's process does not answer, all else is what it told
    last."""
    t: str
    """When this was so, UTC."""
    rig: str
    """Name of the rig."""
    simulated: bool
    """No real light, no real arm."""
    run: str | None
    """Name of the run that is being acquired."""
    view: str | None
    """View that is being acquired."""
    proven: int
    """Frames of the run that are proven."""
    frames: int
    """Frames of the run."""
    dose: float
    """Light of the run on the object, in lux hours."""
    object: str
    """Id of the object of the run; empty if none is named."""
    dose_before: float
    """Light on the object before the run, in lux hours."""
    dose_budget: float | None
    """Light that the object may receive in its life, by its ledger and the run's plan."""
    left_s: float | None
    """Expected until the run is complete."""
    halted: str
    """Why the queue waits for a person; empty if it does not."""
    arm_fault: str
    """The fault of the arm that stands until a person confirms; empty if there is none."""
    devices: dict[str, Any]
    """Identities of the devices that a run, or the bench, has open."""
    lent_to: str
    """To whom the cell is lent, and for what; empty if it is not. Nothing begins meanwhile."""
    queue: list[EntryNow]
    """All entries that run or wait, after the 20 that ended last, in their order."""
    checking: str
    """What preflight is being made of, for whom, since when and how far it is; empty if of nothing. What else is
    entered waits for it."""
    in_control: str
    """Who may act; empty: any operator."""
    asked_by: str
    """Who asks for control."""
    trouble: str
    """What the service itself cannot do, such as write its log; empty if nothing."""
