"""Routes of the HTTP interface for work at the cell other than runs: its loan, light entered by hand, the queue's
order, its preflight."""

from __future__ import annotations

from typing import Any

from anyio import to_thread
from fastapi import FastAPI, Request

from coupole.console.cell.lending import begun_here
from coupole.console.people.accounts import Role
from coupole.console.people.asking import REFUSALS, Who
from coupole.console.people.guard import is_command_line
from coupole.console.people.permission import NotAllowed, allow
from coupole.console.routes.messages import Budget, Lease, Light, Move, Output, StateNow, Text, Warn
from coupole.console.service_parts import Service
from coupole.errors import InputError
from coupole.plan.cell import Cell
from coupole.storage.ledger import Ledger, ledger_of, similar_ids
from coupole.viewing import dose_table


def add_routes_at_the_cell(app: FastAPI, service: Service) -> None:
    _add_loan(app, service)
    _add_light(app, service, service.cell)

    @app.post("/api/v1/queue/{entry}/move", responses=REFUSALS)
    async def move(entry: Text, place: Move, person: Who) -> StateNow:
        """Move a waiting entry before another one, or to the end."""
        allow(service, person, Role.OPERATOR, "move", acts=True)
        limiter = service.entering.one_at_a_time
        await to_thread.run_sync(service.entering.move, entry, place.before, limiter=limiter)
        return service.state()

    @app.delete("/api/v1/preflight", responses=REFUSALS)
    def give_up(person: Who) -> dict[str, str]:
        """Give up the present preflight; its plan or run is not entered."""
        allow(service, person, Role.OPERATOR, "give up a preflight")
        words = service.entering.preflight.words
        service.entering.preflight.give_up()
        return {"given_up": words}

    @app.get("/api/v1/queue/{entry}/output", responses=REFUSALS)
    def output(entry: Text) -> Output:
        """Return the output of an entry's process."""
        queue_entry = service.queue.entry(entry)
        output_text, figures = service.acquisitions.output(queue_entry)
        return Output(entry=queue_entry, said=output_text, figures=figures)


def _add_loan(app: FastAPI, service: Service) -> None:
    def borrower(request: Request) -> int:
        if not is_command_line(request) or request.client is None:
            raise NotAllowed(
                403, "the cell is lent only to commands on this machine, through the console's own socket"
            )
        return request.client.port

    @app.post("/api/v1/cell/lease", responses=REFUSALS)
    def lend(lease: Lease, person: Who, request: Request) -> dict[str, str]:
        """Lend the cell to the process that asks, through the Unix socket, until it gives the cell back or ends.
        The queue waits meanwhile. A process that the console itself has begun acts for the person who began it
        there."""
        allow(service, person, Role.OPERATOR, lease.what)
        pid = borrower(request)
        if not begun_here(pid):
            allow(service, person, Role.OPERATOR, lease.what, acts=True)
        request.state.about = lease.what
        try:
            service.acquisitions.lend(pid, person.name, lease.what)
        except InputError as error:
            raise NotAllowed(409, f"{lease.what}: {error}") from error
        return {"lent_to": service.acquisitions.lending.lent_to}

    @app.delete("/api/v1/cell/lease", responses=REFUSALS)
    def give_back(person: Who, request: Request) -> dict[str, str]:
        """Give the cell back."""
        allow(service, person, Role.OPERATOR, "give back")
        service.acquisitions.lending.give_back(borrower(request))
        return {"lent_to": service.acquisitions.lending.lent_to}


def _add_light(app: FastAPI, service: Service, cell: Cell) -> None:
    def document(ledger: Ledger) -> dict[str, Any]:
        return dose_table.document(ledger, ledger.read_history(), similar_ids(ledger.folder, ledger.object_id))

    @app.get("/api/v1/objects/{thing}/light", responses=REFUSALS)
    def light(thing: Text) -> dict[str, Any]:
        """Return all light that an object has received by its ledger, as in `coupole dose --json`."""
        return document(ledger_of(cell, thing))

    @app.post("/api/v1/objects/{thing}/light", responses=REFUSALS)
    def enter(thing: Text, new_light: Light, person: Who, request: Request) -> dict[str, Any]:
        """Enter light that was given elsewhere into an object's ledger."""
        allow(service, person, Role.OPERATOR, "enter light")
        request.state.about = f"{new_light.dose_lux_h:g} lux.h: {new_light.note}"
        ledger = ledger_of(cell, thing)
        ledger.enter(new_light.dose_lux_h, new_light.note)
        return document(ledger)

    @app.post("/api/v1/objects/{thing}/budget", responses=REFUSALS)
    def set_budget(thing: Text, budget: Budget, person: Who, request: Request) -> dict[str, Any]:
        """Set the light that an object may receive in its life; a named person is responsible for it."""
        allow(service, person, Role.OPERATOR, "set a light budget")
        request.state.about = f"{budget.dose_lux_h:g} lux.h: {budget.reason}"
        ledger = ledger_of(cell, thing)
        name = budget.name.strip() or person.name
        ledger.set_budget(
            budget.dose_lux_h, name if name == person.name else f"{name} (by {person.name})", budget.reason
        )
        return document(ledger)

    @app.post("/api/v1/objects/{thing}/warning", responses=REFUSALS)
    def warn(thing: Text, warning: Warn, person: Who, request: Request) -> dict[str, Any]:
        """Set the light above which an object's ledger warns."""
        allow(service, person, Role.OPERATOR, "warn")
        request.state.about = f"above {warning.above_lux_h} lux.h"
        ledger = ledger_of(cell, thing)
        ledger.warn_above(warning.above_lux_h)
        return document(ledger)
