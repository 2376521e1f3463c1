"""What `tools/day.py` judges a day by, in a few minutes of one."""

from __future__ import annotations

from pathlib import Path

from long_day import WORLD, Watcher, cell_in, wrong_at_the_end


def test_a_watched_run_has_true_labels_loses_nothing_and_a_false_label_is_seen(tmp_path: Path) -> None:
    """Three views of 36 LEDs in a world that runs fast only while the command waits."""
    cell = cell_in(tmp_path, 0.015, 36, 50.0)
    with cell.world(**WORLD) as world:
        watcher = Watcher(cell, world, seed=1)
        for _ in watcher.follow():
            pass
    day = watcher.day
    assert wrong_at_the_end(cell, day) == []
    assert day.samples[-1]["controller"]["threads"] > 1
    assert day.samples[-1]["on disk"]["journal"] > 0
    watcher._shone[10**6] = {30: 1.0}
    watcher._judge("v0000/led0060/e0", 10**6)
    assert len(day.mislabelled) == 1
