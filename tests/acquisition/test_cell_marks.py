"""A cell whose devices are open is marked at every moment, whoever asks; one that only one session can have is had
by one."""

from __future__ import annotations

import json
import time
from multiprocessing.synchronize import Event
from pathlib import Path

import cells
import pytest
from cells import CellFolder
from forks import fork_context

from coupole.acquisition import cell_marks, runtime_folder
from coupole.acquisition.cell_bench.bench_client import ask_bench
from coupole.acquisition.cell_marks import in_use, is_in_use
from coupole.errors import InputError, StorageError
from coupole.plan.cell import Cell, read_cell

SESSIONS = 1000
"""Of these some were unmarked while another program asked, as long as who asks took the lock for a moment."""


@pytest.fixture
def real(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> CellFolder:
    """The rig of a real cell: it names devices, and no world."""
    monkeypatch.setattr(cell_marks, "_GRACE_S", 0.05)
    cell = CellFolder(tmp_path, write_now=False)
    del cell.rig_data["world"]
    cell.rig_data["ledbox"]["settings"]["port"] = "/dev/nowhere"
    cell.rig_data["camera"]["settings"] = {"address": "/nowhere"}
    cell.rig_data["robot"]["settings"]["listen"] = "127.0.0.1:1"
    cell.write()
    return cell


def _asks_all_the_time(rig: Path, begun: Event, over: Event) -> None:
    cell = read_cell(rig)
    while not over.is_set():
        is_in_use(cell)
        begun.set()


@pytest.mark.parametrize("kind", ["cell", "real"])
def test_a_session_is_marked_whoever_asks_meanwhile(request: pytest.FixtureRequest, kind: str) -> None:
    asked = read_cell(request.getfixturevalue(kind).rig)
    context = fork_context()
    begun, over = context.Event(), context.Event()
    asking = context.Process(target=_asks_all_the_time, args=(asked.document.path, begun, over))
    asking.start()
    try:
        assert begun.wait(cells.PATIENCE_S)
        unmarked = 0
        for _ in range(SESSIONS):
            with in_use(asked):
                unmarked += not is_in_use(asked)
    finally:
        over.set()
        asking.join()
    assert unmarked == 0
    assert not is_in_use(asked)


def test_two_who_ask_do_not_take_each_other_for_a_session(real: CellFolder) -> None:
    asked = read_cell(real.rig)
    with in_use(asked):
        pass
    context = fork_context()
    begun, over = context.Event(), context.Event()
    asking = context.Process(target=_asks_all_the_time, args=(real.rig, begun, over))
    asking.start()
    try:
        assert begun.wait(cells.PATIENCE_S)
        assert not any(is_in_use(asked) for _ in range(SESSIONS))
    finally:
        over.set()
        asking.join()


def _may_begin(cell: Cell) -> bool:
    try:
        with in_use(cell):
            return True
    except InputError:
        return False


def _has(rig: Path, begun: Event) -> None:
    with in_use(read_cell(rig)):
        begun.set()
        begun.wait()
        while True:
            time.sleep(60.0)


def test_two_sessions_of_a_real_cell_exclude_each_other_until_the_first_is_killed(real: CellFolder) -> None:
    context = fork_context()
    begun = context.Event()
    first = context.Process(target=_has, args=(real.rig, begun))
    first.start()
    assert begun.wait(cells.PATIENCE_S)
    cell = read_cell(real.rig)
    with pytest.raises(InputError, match="another process has this cell's devices open"), in_use(cell):
        pass
    assert is_in_use(cell)
    first.kill()
    first.join()
    assert _may_begin(cell)


def test_a_copied_rig_with_another_storage_folder_is_the_same_cell(real: CellFolder) -> None:
    first = read_cell(real.rig)
    copy = real.folder / "copy.yaml"
    real.rig_data["storage"]["folder"] = str(real.folder / "elsewhere")
    copy.write_text(json.dumps(real.rig_data))
    with in_use(first):
        assert not _may_begin(read_cell(copy))
        assert is_in_use(read_cell(copy))


def test_who_asks_for_a_bench_where_another_command_has_the_cell_is_told_so(real: CellFolder) -> None:
    cell = read_cell(real.rig)
    with pytest.raises(InputError, match="no bench of this user holds this cell"):
        ask_bench(cell, "state")
    with in_use(cell), pytest.raises(InputError, match="another process has this cell's devices open"):
        ask_bench(cell, "state")


def test_sessions_with_a_world_of_their_own_share_no_device_and_are_marked(cell: CellFolder) -> None:
    simulated = read_cell(cell.rig)
    with in_use(simulated):
        assert _may_begin(simulated)
        assert is_in_use(simulated), "the other's end has not taken this one's mark away"


def test_a_real_cell_that_cannot_be_marked_is_not_opened_and_a_simulated_one_is(
    real: CellFolder, tmp_path_factory: pytest.TempPathFactory, monkeypatch: pytest.MonkeyPatch
) -> None:
    simulated = CellFolder(tmp_path_factory.mktemp("simulated"))
    monkeypatch.setattr(runtime_folder, "_BASE", real.folder / "nowhere")
    with pytest.raises(StorageError, match="cannot mark the cell"), in_use(read_cell(real.rig)):
        pass
    assert _may_begin(read_cell(simulated.rig))
