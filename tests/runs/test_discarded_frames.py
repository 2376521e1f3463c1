"""`discard: after_fit`: frames go when their samples are safe, by the plan's words alone; nothing is ever lost."""

from __future__ import annotations

import json
import os
import shutil
import signal
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cells
import h5py
import pytest
from beside_runs import begun, cell_of_three_views, files, is_beside, result_of
from cells import CellFolder
from discarded_runs import (
    DISCARDED,
    KEPT_LEDS,
    all_discarded,
    discarding_cell,
    everything_is_there,
    frames,
    nothing_is_lost,
    resume,
)
from killed_discarding import REWRITTEN, STEPS
from nursery import NURSERY

from coupole.errors import ChecksumMismatch, StorageError
from coupole.preflight.discard_room import discard_room
from coupole.preflight.job import read_job
from coupole.reflectance.run_job import RunRequest, extract_runs
from coupole.storage import discarding, sample_proofs
from coupole.storage.given_back import why_not
from coupole.storage.journal_events import FindingNoted
from coupole.storage.run import Run

pytestmark = [
    pytest.mark.timeout(900),
    pytest.mark.usefixtures("hurried"),
    pytest.mark.skipif(
        bool(why_not(Path(tempfile.gettempdir()))), reason="the disk cannot give back parts of files"
    ),
]


@pytest.fixture(scope="module")
def acquired(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A run whose processing was killed before it had samples: all its frames are there. It was moved since."""
    folder = tmp_path_factory.mktemp("acquired")
    cell = discarding_cell(folder)
    process, worker = begun(cell)
    os.kill(worker, signal.SIGKILL)
    ended = cells.finish(process)
    assert ended.code == 0, ended.err
    run = cell.run_folder
    assert not cells.events(run, "discard")
    everything_is_there(run)
    shutil.move(folder / "storage", folder / "moved")
    return folder / "moved" / run.name


@pytest.fixture
def pending(acquired: Path, tmp_path: Path) -> tuple[Path, Path]:
    """A copy of that run, and the folder of its result, which is not there."""
    run = tmp_path / acquired.name
    shutil.copytree(acquired, run)
    return run, tmp_path / f"{acquired.name}-reflectance"


@pytest.fixture(scope="module")
def samples_of_all_frames(acquired: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    """The samples as they are taken from all frames, into a result for which nothing is discarded."""
    out = tmp_path_factory.mktemp("other") / "result"
    extract_runs(RunRequest((acquired,)), out)
    everything_is_there(acquired)
    return {path.name: path.read_bytes() for path in (out / "samples").glob("*.h5")}


def bounds_hold(cell: CellFolder, run: Path, result: Path) -> None:
    """What preflight says of the disk is enough, and not much too much."""
    room = discard_room(read_job(cell.plan))
    for name, view in room.views.items():
        samples = [result / "samples" / f"{name}.h5", result / "samples/frames" / f"{name}.h5"]
        size = sum(path.stat().st_size for path in samples)
        assert view.sample_bytes / 3 < size <= view.sample_bytes
        file = (run / "views" / f"{name}.h5").stat()
        assert file.st_size <= view.frame_bytes
        assert file.st_blocks * 512 <= view.kept_bytes
    others = sum(path.stat().st_size for path in files(result).values() if "samples" not in path.parts)
    assert others <= room.fit_bytes


def spoil(samples: Path) -> None:
    """Change one bit of one sample."""
    with h5py.File(samples, "r+") as file:
        file["codes"][7, 3] ^= 1


def killed(step: str, run: Path, out: Path) -> int:
    with NURSERY.function("killed_discarding:discard", [step, str(run), str(out)]) as process:
        return process.wait()


# -- the run --------------------------------------------------------------------------------------------------


def test_frames_are_discarded_when_their_samples_are_safe_and_all_commands_understand(tmp_path: Path) -> None:
    cell = discarding_cell(tmp_path)
    process, _ = begun(cell)
    ended = cells.finish(process)
    assert ended.code == 0, ended.err
    assert ended.document["reflectance"]["is_whole"], ended.err
    run, result = cell.run_folder, result_of(cell)
    all_discarded(run, result)

    told = cells.here("status", run, "--json").document
    assert told["frames_discarded"] == 3 * DISCARDED
    assert told["state"] == "done"
    assert "frames were discarded when their samples were safe" in cells.here("status", run).err
    verified = cells.here("verify", run, "--json")
    assert verified.document["ok"]
    assert (verified.document["frames"], verified.document["discarded"]) == (3 * 16, 3 * DISCARDED)
    assert str(result) in cells.here("verify", run).err
    assert cells.here("report", run).code == 0
    assert not verified.document["unlisted"]

    refused = cells.here("export", run, "--to", "tiff", "--out", tmp_path / "tiffs")
    assert refused.code == 2
    assert "were discarded when their samples were safe" in refused.err
    assert "With --shots, name frames that were not discarded, such as `dark" in refused.err
    assert not (tmp_path / "tiffs").exists()
    for to in ("colmap", "iiif", "lp", "relight"):
        late = cells.here("export", run, "--to", to, "--out", tmp_path / "views" / to)
        assert late.code == 2
        assert f"--to {to} needs the frames of all LEDs. `coupole export {result}`" in late.err
        assert not (tmp_path / "views").exists()
    assert cells.here("export", run, "--to", "dome", "--out", tmp_path / "domes").code == 0
    shots = [word for led in KEPT_LEDS for word in ("--shots", f"led{led:04d}/e0")]
    assert cells.here("export", run, "--to", "tiff", "--out", tmp_path / "tiffs", *shots).code == 0
    assert len(list((tmp_path / "tiffs").iterdir())) == 3 * len(KEPT_LEDS)
    other = cells.here("reflectance", run, "--out", tmp_path / "other")
    assert other.code == 2
    assert f"coupole reflectance {run} --out {result}" in other.err
    texels = cells.here("reflectance", run, "--out", result, "--texels", "2")
    assert texels.code == 2
    assert "--texels: needs the frames of all LEDs" in texels.err
    other = cells.here("acquire", "--resume", run, "--result", tmp_path / "other", "--yes")
    assert other.code == 3
    assert "no other result can be made" in other.err
    again = cells.here("reflectance", run, "--out", result)
    assert again.code == 0, again.err
    resume(run)
    all_discarded(run, result)
    picture = ("--view", "top", "--led", "96", "--uncertainty", tmp_path / "u.npy", "--to", tmp_path / "relit.npy")
    relit = cells.here("reflectance", "relight", result, *picture)
    assert relit.code == 0, relit.err

    assert cells.here("archive", run).code == 0
    verified = cells.here("verify", run, "--json")
    assert verified.document["ok"]
    assert verified.document["discarded"] == 3 * DISCARDED
    assert cells.here("reflectance", run, "--out", result).code == 0


def test_preflight_bounds_the_room_that_is_taken(tmp_path: Path) -> None:
    """Of the whole relief, whose samples take as much room as frames; of so few LEDs no material is fitted."""
    cell = discarding_cell(tmp_path, cells.RELIEF, lights={"kind": "every", "every": 60})
    process, _ = begun(cell)
    ended = cells.finish(process)
    assert ended.document["reflectance"]["is_whole"], ended.err
    bounds_hold(cell, cell.run_folder, result_of(cell))


def test_the_result_is_the_same_as_that_of_all_frames(
    acquired: Path, pending: tuple[Path, Path], tmp_path: Path
) -> None:
    run, result = pending
    for one, out in ((run, result), (acquired, tmp_path / "of-all")):
        ended = cells.here("reflectance", one, "--out", out)
        assert ended.code == 0, ended.err
    all_discarded(run, result)
    everything_is_there(acquired)
    mine, others = files(result), files(tmp_path / "of-all")
    assert mine.keys() - others.keys() == {sample_proofs.NAME}
    for name in others.keys() - {"result.json", "report.html"}:
        assert mine[name].read_bytes() == others[name].read_bytes(), name


def test_without_the_plans_word_nothing_is_discarded(tmp_path: Path) -> None:
    cell = cell_of_three_views(tmp_path, lights={"kind": "every", "every": 60})
    process, worker = begun(cell)
    cells.wait_until(
        lambda: list((result_of(cell) / "samples").glob("*.json")) or not is_beside(worker), "samples"
    )
    process.send_signal(signal.SIGINT)
    cells.finish(process)
    everything_is_there(cell.run_folder)
    assert not (result_of(cell) / sample_proofs.NAME).exists()


OFTEN = {
    "they are read back, it is not noted",
    "the journal's line is cut",
    "the journal has the line",
    "a part of the frames is marked",
    "they are noted, not in place",
}
"""Steps after which a mistake would lose most; the others are for `--full`."""


def seldom(steps: Iterable[str], often: set[str]) -> list[Any]:
    """Parameters: those that are not `often` are for `--full`."""
    return [pytest.param(step, marks=[] if step in often else pytest.mark.full) for step in steps]


# -- killed between any two steps -----------------------------------------------------------------------------


@pytest.mark.parametrize("step", seldom(STEPS, OFTEN))
def test_killed_at_any_step_no_frame_is_lost_and_it_goes_on(
    step: str, pending: tuple[Path, Path], samples_of_all_frames: dict[str, bytes]
) -> None:
    run, result = pending
    assert killed(step, run, result) == -signal.SIGKILL
    nothing_is_lost(run, result)
    assert cells.here("verify", run, "--manifest").code == 0  # lists files as they are now
    assert killed("", run, result) == 0
    all_discarded(run, result)
    for name, content in samples_of_all_frames.items():
        assert (result / "samples" / name).read_bytes() == content


@pytest.mark.parametrize("step", seldom(REWRITTEN, OFTEN))
def test_killed_while_samples_are_replaced_they_are_proven_still(step: str, pending: tuple[Path, Path]) -> None:
    run, result = pending
    assert killed(step, run, result) == -signal.SIGKILL
    all_discarded(run, result)
    ended = cells.here("reflectance", run, "--out", result)
    assert ended.code == 0, ended.err
    all_discarded(run, result)


def test_an_acquisition_that_is_killed_while_it_discards_is_resumed(tmp_path: Path) -> None:
    cell = discarding_cell(tmp_path)
    process, worker = begun(cell)
    cells.wait_until(lambda: cells.events(cell.run_folder, "discard"), "a view that is discarded")
    progress = json.loads((result_of(cell) / "beside/progress.json").read_text())
    assert progress["undrawn"] == "result so far and page to relight: the plan discards frames"
    process.kill()
    cells.finish(process)
    end_s = time.monotonic() + 5.0
    while is_beside(worker) and time.monotonic() < end_s:
        time.sleep(0.02)
    run, result = cell.run_folder, result_of(cell)
    if cells.here("status", run, "--json").document["frames_left"] == 0:
        nothing_is_lost(run, result)
    resume(run)
    all_discarded(run, result)


# -- whatever is not sure, stays ------------------------------------------------------------------------------


def test_samples_that_differ_when_read_back_discard_nothing_and_are_taken_again(
    pending: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, result = pending
    real = sample_proofs.digest_on_disk

    def of_a_disk_that_fails(path: Path) -> str:
        spoil(path)
        return real(path)

    monkeypatch.setattr(sample_proofs, "digest_on_disk", of_a_disk_that_fails)
    with pytest.raises(ChecksumMismatch, match="differs from what was written"):
        extract_runs(RunRequest((run,)), result)
    everything_is_there(run)
    monkeypatch.undo()
    extract_runs(RunRequest((run,)), result)
    all_discarded(run, result)


def test_a_journal_that_takes_nothing_discards_nothing(
    pending: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    run, result = pending

    def full(*_: object) -> None:
        raise StorageError("the disk is full")

    monkeypatch.setattr("coupole.storage.journal.append_lines", full)
    with pytest.raises(StorageError, match="full"):
        extract_runs(RunRequest((run,)), result)
    everything_is_there(run)
    monkeypatch.undo()
    extract_runs(RunRequest((run,)), result)
    all_discarded(run, result)


def test_a_view_with_a_finding_keeps_its_frames(pending: tuple[Path, Path]) -> None:
    run, result = pending
    shot = next(iter(Run(run).proven()))
    finding = FindingNoted(
        kind="moved", view="side", shots=(shot,), figure=1.0, limit=0.1, unit="mm", message="It moved."
    )
    with (run / "journal.jsonl").open("a") as journal:
        journal.write(json.dumps(finding.model_dump(mode="json")) + "\n")
    extract_runs(RunRequest((run,)), result)
    assert nothing_is_lost(run, result) == 2 * DISCARDED
    assert all(is_there for shot, is_there, _ in frames(run) if shot.startswith("side/"))


def test_views_after_one_that_is_not_complete_keep_their_frames(pending: tuple[Path, Path]) -> None:
    run, _ = pending
    journal = run / "journal.jsonl"
    views = list(dict.fromkeys(str(shot.view) for shot in Run(run).proven()))
    first_light = next(line for line in journal.read_text().splitlines(True) if f'"{views[1]}/led' in line)
    journal.write_text(journal.read_text().replace(first_light, ""))
    assert discarding.reason_to_keep(Run(run), views[0]) == ""
    for view in views[1:]:
        assert discarding.reason_to_keep(Run(run), view) == f"the view {views[1]} is not complete"


def test_a_view_whose_samples_are_damaged_or_gone_is_told_and_nothing_is_made_of_it(
    pending: tuple[Path, Path],
) -> None:
    run, result = pending
    extract_runs(RunRequest((run,)), result)
    path = result / "samples/top.h5"
    whole = path.read_bytes()
    spoil(path)
    for words in ("differs from what was proven", "is missing"):
        ended = cells.here("verify", run)
        assert ended.code == 6, ended.err
        assert words in ended.err
        with pytest.raises(ChecksumMismatch, match=words):
            extract_runs(RunRequest((run,)), result)
        path.unlink(missing_ok=True)
    told = cells.here("status", run, "--json").document["processing"]
    assert (told["state"], told["remedy"]) == ("failed", "")
    assert "top.h5 is missing: put it back" in told["why"]
    path.write_bytes(whole)
    assert cells.here("verify", run).code == 0


def test_a_frame_that_was_discarded_cannot_be_claimed_by_another_hash(pending: tuple[Path, Path]) -> None:
    run, result = pending
    extract_runs(RunRequest((run,)), result)
    journal = run / "journal.jsonl"
    lines = journal.read_text().splitlines(keepends=True)
    place = next(n for n, line in enumerate(lines) if line.startswith('{"event":"discard"'))
    event = json.loads(lines[place])
    event["frames"][0][1] = "0" * 16
    lines[place] = json.dumps(event, separators=(",", ":")) + "\n"
    journal.write_text("".join(lines))
    ended = cells.here("verify", run)
    assert ended.code == 6
    assert "discarded frames that it has not proven" in ended.err
