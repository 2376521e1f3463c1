"""The process beside an acquisition: `python -m coupole.reflectance.beside.process PARENT`.

It reads lines of JSON from its input. The first names plan, rig and result; the process answers with the `reasons`
against a result. The next names the run's folder, the result's folder, and the module that makes pages to relight.
From then on the process follows the run's journal, and reports its progress in lines on its output. It ends when
its input ends: then its parent has died, or does not need it any more.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
from pathlib import Path
from typing import Any

from coupole.intake.plain_data import json_of
from coupole.reflectance.beside.lowest_priority import ThreadForTheEnd, end_with, yield_to_all_others


def main() -> None:
    """Run until the result is complete or the input ends."""
    end_with(int(sys.argv[1]))
    for number in (signal.SIGINT, signal.SIGHUP):  # Ctrl-C is for the acquisition, which ends this
        signal.signal(number, signal.SIG_IGN)
    _say({"reasons": _reasons(_next_request())})  # before anything moves or shines, and for this somebody waits
    yield_to_all_others(but=(thread_for_the_end := ThreadForTheEnd()))
    request = _next_request()
    threading.Thread(target=_end_with_input, name="end with input", daemon=True).start()

    from coupole.reflectance.beside.follower import process_run

    is_whole = process_run(
        Path(request["run"]), Path(request["result"]), _say, thread_for_the_end.run, request["page_program"]
    )
    sys.stdout.flush()
    os._exit(0 if is_whole else 1)  # no thread is waited for


def _reasons(request: dict[str, Any]) -> list[str]:
    """Return the reasons against a result; a missing library is one of them, with the extra that installs it."""
    try:
        from coupole.reflectance.beside import follower
        from coupole.reflectance.beside.beforehand import reasons_against
    except ImportError as error:
        return [f"--reflectance: needs {error.name or error}, which is not installed: pip install 'coupole[all]'"]
    assert follower is not None  # imported now: nothing is missing later
    rig, result, run = (None if request[key] is None else Path(request[key]) for key in ("rig", "result", "run"))
    return reasons_against(Path(request["plan"]), rig, result, run)


def _next_request() -> dict[str, Any]:
    line = sys.stdin.readline()
    if not line:
        os._exit(1)
    request: dict[str, Any] = json_of(line, "the request")
    return request


def _say(document: dict[str, Any]) -> None:
    try:
        print(json.dumps(document), flush=True)
    except OSError:  # nobody listens any more
        os._exit(1)


def _end_with_input() -> None:
    sys.stdin.read()
    os._exit(1)


if __name__ == "__main__":
    main()
