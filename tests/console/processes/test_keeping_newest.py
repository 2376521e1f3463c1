"""What a console makes for a while does not fill the disk."""

from __future__ import annotations

import os
from pathlib import Path

from coupole.console.plans.plan_files import PlanFiles
from coupole.console.processes.tasks import Tasks


def test_the_newest_drawings_and_outputs_are_kept(tmp_path: Path) -> None:
    drawings, commands = tmp_path / "drawings", tmp_path / "commands"
    commands.mkdir()
    for number in range(53):
        drawing, log = drawings / f"{number:02}", commands / f"{number:02}.log"
        drawing.mkdir(parents=True)
        (drawing / "cell.png").write_text("picture")
        log.write_text("said")
        for path in (drawing, log):
            os.utime(path, (number, number))
    plans = PlanFiles(tmp_path, tmp_path / "rig.yaml", drawings)
    assert sorted(path.name for path in drawings.iterdir()) == [f"{n:02}" for n in range(3, 53)]
    new = plans.new_drawing()
    assert (new.parent, new.exists(), len(list(drawings.iterdir()))) == (drawings, False, 49)
    Tasks(commands)
    assert sorted(path.stem for path in commands.iterdir()) == [f"{n:02}" for n in range(3, 53)]
