"""The manifest, as coreutils read it; and that it never lists what is not so."""

from __future__ import annotations

import hashlib
import shutil
import subprocess
import threading
from collections.abc import Callable
from pathlib import Path

import cells
import pytest
from archives import MadeRun, make_run
from watchers_clock import WatchersClock

from coupole import bounded
from coupole.acquisition import conclusion
from coupole.acquisition.conclusion import conclude, open_for_session, renew_report
from coupole.errors import StorageError
from coupole.storage import manifest
from coupole.storage.archive import archive_run
from coupole.storage.bitshuffle import codec_of
from coupole.viewing.terminal import make_console


@pytest.fixture
def made(tmp_path: Path) -> MadeRun:
    return make_run(tmp_path, shots=2)


def sha256sum(run: Path) -> subprocess.CompletedProcess[str]:
    """coreutils' opinion."""
    tool = shutil.which("sha256sum")
    assert tool, "no coreutils here"
    options = ["--check", "--strict", "--quiet", manifest.NAME]
    return subprocess.run([tool, *options], cwd=run, check=False, capture_output=True, text=True)


def test_coreutils_find_every_file_as_the_manifest_lists_it(made: MadeRun) -> None:
    conclude(made.run, make_console(quiet=True))
    checked = sha256sum(made.run.folder)
    assert (checked.returncode, checked.stdout, checked.stderr) == (0, "", "")
    on_disk = {str(path.relative_to(made.run.folder)) for path in made.run.folder.rglob("*") if path.is_file()}
    assert set(manifest.read_checksums(made.run.folder)) == on_disk - {manifest.NAME}


@pytest.mark.parametrize(
    "name", ["run.json", "journal.jsonl", "report.html", "README.txt", "inputs/plan.yaml", "views/side.h5"]
)
def test_verify_names_a_file_that_was_changed_or_is_gone(made: MadeRun, name: str) -> None:
    """In a view's file a byte of its tables, which no frame's checksum covers."""
    conclude(made.run, make_console(quiet=True))
    path = made.run.folder / name
    whole = path.read_bytes()
    at = whole.index(b"NXpositioner") if path.suffix == ".h5" else len(whole) - 2
    path.write_bytes(whole[:at] + bytes([whole[at] ^ 1]) + whole[at + 1 :])
    assert sha256sum(made.run.folder).returncode == 1
    if name != "run.json":  # of which it would be no run
        verified = cells.here("verify", made.run.folder, "--json")
        assert verified.code == 6
        assert [problem.split(":")[0] for problem in verified.document["bad"]] == [name]
        path.unlink()
        assert "cannot be read" in manifest.problems(made.run.folder)[name]


def test_a_slow_disk_that_answers_is_waited_for(made: MadeRun, monkeypatch: pytest.MonkeyPatch) -> None:
    """Hashing a run's views took 194 s beside other work, and was called a disk that does not answer."""
    clock = WatchersClock()
    monkeypatch.setattr(bounded, "time", clock)
    monkeypatch.setattr(bounded, "DISK_S", 0.8)
    monkeypatch.setattr(conclusion, "_SLOWEST_BYTES_S", 1e12)
    size = max(path.stat().st_size for path in (made.run.folder / manifest.VIEWS).iterdir())
    monkeypatch.setattr(manifest, "_CHUNK_BYTES", size // 5 + 1)
    hashed = manifest._synced_sha256

    def slowly(path: Path, stop: threading.Event, on_read: Callable[[], None]) -> str:
        def read() -> None:
            clock.advance(0.2)
            on_read()

        return hashed(path, stop, read)

    monkeypatch.setattr(manifest, "_synced_sha256", slowly)
    conclude(made.run, make_console(quiet=True))
    assert {"views/side.h5", "views/top.h5"} <= set(manifest.read_checksums(made.run.folder))


def test_a_session_takes_out_what_it_writes_and_keeps_complete_views(tmp_path: Path) -> None:
    made = make_run(tmp_path, shots=2, missing=("side/led0001/e0",))
    conclude(made.run, make_console(quiet=True))
    assert "views/side.h5" not in manifest.read_checksums(made.run.folder)
    open_for_session(made.run)
    left = set(manifest.read_checksums(made.run.folder))
    assert "views/top.h5" in left
    assert {"run.json", "README.txt", "inputs/plan.yaml", "inputs/rig.yaml"} <= left
    assert not {"journal.jsonl", "report.html", "views/side.h5"} & left
    assert sha256sum(made.run.folder).returncode == 0


def test_large_views_are_left_to_verify_which_enters_them_on_request(
    made: MadeRun, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("coupole.acquisition.conclusion.MOST_HASHED_BYTES", 1000)
    conclude(made.run, make_console(quiet=True))
    assert "views/top.h5" not in manifest.read_checksums(made.run.folder)
    assert cells.here("verify", made.run.folder, "--json").document["unlisted"] == [
        "views/side.h5",
        "views/top.h5",
    ]
    assert cells.here("verify", made.run.folder, "--manifest").code == 0
    for view in ("top", "side"):
        path = made.run.view_path(view)
        assert (
            manifest.read_checksums(made.run.folder)[f"views/{view}.h5"]
            == hashlib.sha256(path.read_bytes()).hexdigest()
        )


def test_archived_views_and_a_new_report_are_entered_again(made: MadeRun) -> None:
    conclude(made.run, make_console(quiet=True))
    archive_run(made.run, codec_of("lz4"), keep=True)
    renew_report(made.run)
    assert sha256sum(made.run.folder).returncode == 0
    assert manifest.unlisted_files(made.run.folder) == []


def test_while_a_session_writes_a_new_report_is_not_entered(made: MadeRun) -> None:
    with made.run.hold_lock():
        open_for_session(made.run)
        renew_report(made.run)
    assert "report.html" not in manifest.read_checksums(made.run.folder)


def test_a_line_that_is_none_is_refused_with_its_number(made: MadeRun) -> None:
    with (made.run.folder / manifest.NAME).open("a") as file:
        file.write("no checksum\n")
    with pytest.raises(StorageError, match=r"manifest.sha256: line \d+ is not"):
        manifest.read_checksums(made.run.folder)


def test_a_run_without_a_manifest_is_verified(made: MadeRun) -> None:
    (made.run.folder / manifest.NAME).unlink()
    verified = cells.here("verify", made.run.folder, "--json")
    assert (verified.code, verified.document["listed"]) == (0, 0)
