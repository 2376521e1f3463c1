"""Messages to the console, and its answers, version 1."""

from __future__ import annotations

import unicodedata
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field

from coupole.console.plans.plan_queue import Entry


def _printable(text: str) -> str:
    """Refuse what would move a terminal's cursor, colour its text or begin a line where the text is printed."""
    if any(unicodedata.category(character) == "Cc" for character in text):
        raise ValueError("expected one line without control characters")
    return text


Text = Annotated[str, Field(max_length=2000)]
Line = Annotated[Text, AfterValidator(_printable)]
"""Words that are shown to others, also at terminals."""


MOST_LUX_H = 1e9
"""Greatest dose of an entry, in lux hours. Half of it is a hundred thousand years in a museum at 50 lux; more is a
typing error."""


class Asked(BaseModel):
    """Base class of messages to the console: unknown keys are errors."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)


class SignIn(Asked):
    """A name and a password, or the token of the first start."""

    name: Text = ""
    """Name of an account."""
    password: Text = ""
    """Password of the account."""
    token: Text = ""
    """Token that is printed at a start without an engineer's account. It signs in an engineer, once, on the same
    machine."""
    script: bool = False
    """True for a script: the session is returned in `session`, to be sent as a bearer token, instead of a
    cookie."""


class NewEntry(Asked):
    """A plan, a run to be resumed, or a hold."""

    plan: Text = ""
    """File of the plan, relative to the folder of plans."""
    resume: Text = ""
    """Folder of the run to be resumed, relative to the cell's storage folder."""
    hold: Line = ""
    """Task to be done before the queue goes on."""
    before: Text = ""
    """Id of the waiting entry before which the new one is put; empty for the end."""
    now: bool = False
    """Begin at once, with the preflight at the beginning; refused if something runs, waits or has the cell."""
    output: Text = ""
    """Folder for the run, if it is not the rig's; for the command line."""
    with_mesh: bool = False
    """Copy the mesh into the run even if it is large; for the command line."""
    reflectance: bool = False
    """Process the views during the acquisition, and make the result at its end. A resumed run that began with this
    option keeps it in any case."""
    result: Text = ""
    """Folder of the result; by default the run's name followed by `-reflectance`; for the command line."""


class Move(Asked):
    """A place in the queue."""

    before: Text = ""
    """Id of the waiting entry before which the entry is put; empty for the end."""


class Lease(Asked):
    """Request for the loan of the cell."""

    what: Annotated[str, Field(min_length=1, max_length=200)]
    """Purpose of the loan, in words."""


class Permission(Asked):
    """Question of a command whether it may act with devices that are open already."""

    action: Annotated[Line, Field(min_length=1, max_length=200)]
    """The action, in words."""


class Permitted(BaseModel):
    """Answer on who is in control, to a command that drives the arm."""

    in_control: str
    """The person in control; empty if nobody is."""
    may_act: bool
    """True unless another person is in control, or has been in control since the permission."""
    taken_count: int
    """Number of times that somebody came into control. Later questions send the count of the permission."""


class Light(Asked):
    """Light that an object was given elsewhere."""

    dose_lux_h: Annotated[float, Field(ge=0, le=MOST_LUX_H, allow_inf_nan=False, strict=True)]
    """Light dose in lux hours."""
    note: Annotated[Line, Field(min_length=1)]
    """Description of that light."""


class Budget(Asked):
    """Light that an object may receive in its life."""

    dose_lux_h: Annotated[float, Field(ge=0, le=MOST_LUX_H, allow_inf_nan=False, strict=True)]
    """Light dose in lux hours."""
    name: Annotated[Line, Field(max_length=200)] = ""
    """Name of the person who is responsible; empty for the sender."""
    reason: Line = ""
    """Reason for this budget."""


class Warn(Asked):
    """Limit above which an object's ledger warns."""

    above_lux_h: Annotated[float, Field(ge=0, le=MOST_LUX_H, allow_inf_nan=False, strict=True)] | None
    """Total light above which the ledger warns, in lux hours; null: it never warns."""


class EntryNow(Entry):
    """An entry of the queue at this moment."""

    expected_begin: str | None = None
    """UTC; null if the entry has ended, if a person decides (a hold before it, a halted queue), or if the time is
    not known."""
    expected_end: str | None = None
    """UTC; null in the same cases as `expected_begin`."""


class Output(BaseModel):
    """Output of an entry's process."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    entry: Entry
    """The entry."""
    said: str
    """The last 64 KiB of its process's output."""
    figures: dict[str, Any]
    """Figures, as in `coupole acquire --json`; empty until the process has ended."""


class NewAccount(Asked):
    """New account of a person."""

    name: Text
    """Name with which the person signs in."""
    password: Text
    """Password with at least ten characters."""
    role: Literal["observer", "operator", "engineer"]
    """Role: what the person may do."""


class Hand(Asked):
    """Hand-over of control to the person who asked for it."""

    to: Text = ""
    """Name of that person; empty to give control up."""


class StateNow(BaseModel):
    """The present state of the cell."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    state: Literal[
        "idle", "starting", "running", "pausing", "paused", "stopping", "concluding", "halted", "silent"
    ]
    """State in one word. `halted`: the queue waits for a person. `starting`: a plan is checked, and devices are
    opened. `concluding`: devices are closed, and the report is made. `silent`: the run's process does not answer,
    and all other values are its last ones."""
    t: str
    """Time of this state, UTC."""
    rig: str
    """Name of the rig."""
    simulated: bool
    """True if the cell has no real light and no real arm."""
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
    """Expected time until the run is complete, s."""
    halted: str
    """Reason why the queue waits for a person; empty if it does not wait."""
    arm_fault: str
    """The arm's fault that a person has not confirmed yet; empty if there is none."""
    devices: dict[str, Any]
    """Identities of the devices that a run or the bench has open."""
    lent_to: str
    """Name of the borrower of the cell, and the purpose; empty if the cell is not lent. Nothing begins
    meanwhile."""
    queue: list[EntryNow]
    """All running or waiting entries, in their order, after the 20 entries that ended last."""
    checking: str
    """Present preflight: of what, for whom, since when, and how far it is; empty if there is none. Other entries
    wait for it.
    """
    in_control: str
    """Name of the person in control; if it is empty, any operator may act."""
    asked_by: str
    """Name of the person who asks for control."""
    trouble: str
    """Trouble of the service itself, such as a log that cannot be written; empty if there is none."""
