"""What is sent to the console and told by it, version 1."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

from coupole.console.plan_queue import Entry

Text = Annotated[str, Field(max_length=2000)]


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
    """A plan, or a hold."""

    plan: Text = ""
    """File of the plan, relative to the folder of plans."""
    hold: Text = ""
    """What is to be done before the queue goes on."""


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

    state: Literal["idle", "starting", "running", "pausing", "paused", "stopping", "concluding", "halted"]
    """`halted`: the queue waits for a person; `starting`: a plan is checked, and devices are opened; `concluding`:
    devices are closed, the report is made."""
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
    """Light that the object may receive in its life, by the run's plan."""
    left_s: float | None
    """Expected until the run is complete."""
    halted: str
    """Why the queue waits for a person; empty if it does not."""
    arm_fault: str
    """The fault of the arm that stands until a person confirms; empty if there is none."""
    devices: dict[str, Any]
    """Identities of the devices of the run."""
    queue: list[Entry]
    """All entries, in their order."""
    in_control: str
    """Who may act; empty: any operator."""
    asked_by: str
    """Who asks for control."""
    trouble: str
    """What the service itself cannot do, such as write its log; empty if nothing."""
