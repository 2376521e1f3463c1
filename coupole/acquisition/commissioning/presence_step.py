"""The enabling switch, which a person holds at the cell while a console moves the arm. This step sees it held and
released."""

from __future__ import annotations

from coupole.acquisition.commissioning.bench import Bench, StepFailedError
from coupole.clock import Deadline

_WITHIN_S, _POLL_S = 30.0, 0.05


def presence(bench: Bench) -> None:
    """Ask the person to hold and to release the switch. If the rig has no enabling switch, a cell without one
    passes, and its record says so.
    """
    findings, box = bench.findings, bench.opened.ledbox
    findings.remedy = (
        "Check the enabling switch and its cable to the LED box. Until it works, do not move the arm from any "
        "console."
    )
    input_state = box.presence()
    if input_state is None:
        if bench.cell.rig.console.enabling_switch:
            raise StepFailedError(
                "the rig has `console: enabling_switch: true`, but the LED box reports no input for one: check "
                "its wiring and firmware"
            )
        findings.remarks.append(
            "the LED box has no input for an enabling switch: when a console moves the arm by hand, nothing "
            "shows whether anybody is at the cell"
        )
        return
    bench.ask_before("Step presence: nothing moves. Do not hold the enabling switch at the cell yet.")
    findings.at_most("switches that read as held although nobody holds them", int(bool(box.presence())), 0, "")
    for is_held, state in ((True, "held"), (False, "released"), (True, "held"), (False, "released")):
        if not findings.has_passed:
            return
        bench.person.hold_enabling_switch(is_held=is_held)
        is_seen = _is_switch_seen(bench, is_held=is_held)
        findings.at_most(f"the switch was not seen to be {state} within {_WITHIN_S:g} s", int(not is_seen), 0, "")


def _is_switch_seen(bench: Bench, *, is_held: bool) -> bool:
    deadline = Deadline(bench.opened.clock, _WITHIN_S)
    while bench.opened.ledbox.presence() is not is_held:
        if deadline.has_expired:
            return False
        bench.pause(_POLL_S)
    return True
