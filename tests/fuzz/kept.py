"""What a run or a calibration keeps: run.json, journal, a view's HDF5, the manifest, a record. Each is mutated in
a run that is whole otherwise, and all that reads a run is asked.
"""

from __future__ import annotations

import functools
import json
import re
import shutil
import tempfile
from collections.abc import Callable
from pathlib import Path

from fuzz.target import Target
from places import REPO

WITNESS = REPO / "tests/data/version-0.1"
TIME = re.compile(rb"20\d\d-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z")


@functools.cache
def run_of_today() -> Path:
    """A run of two views, made once in a process, without a cell; in a folder that goes with the process."""
    from archives import make_run

    from coupole.acquisition.conclusion import conclude
    from coupole.viewing.terminal import make_console

    _HELD.append(tempfile.TemporaryDirectory())
    run = make_run(Path(_HELD[0].name), shots=2).run
    conclude(run, make_console(quiet=True))
    return run.folder


_HELD: list[tempfile.TemporaryDirectory[str]] = []


def seeds(name: str) -> Callable[[], list[bytes]]:
    """A file of the run of today, and if there is one of the run that version 0.1 left. A case is to be the same
    each time: times are, and what names machine and user is left out."""

    def found() -> list[bytes]:
        data = TIME.sub(b"2026-11-22T07:02:21.024Z", (run_of_today() / name).read_bytes())
        if name == "run.json":
            about = json.loads(data) | {"host": "here", "operator": "somebody"}
            for key in ("plan", "rig"):
                about[key]["path"] = f"/{key}.yaml"
            data = json.dumps(about, indent=2).encode()
        old = WITNESS / "run" / name
        return [data, old.read_bytes()] if old.exists() else [data]

    return found


def refusal(read: Callable[[], object]) -> str:
    """What the program says of a file that it does not take; empty if it takes it."""
    from coupole.errors import CoupoleError

    try:
        read()
    except CoupoleError as error:
        return str(error)
    return ""


def run_beside(folder: Path) -> None:
    """A whole run in the folder, or in the one above if it is that of the views."""
    run = folder.parent if folder.name == "views" else folder
    shutil.copytree(run_of_today(), run, dirs_exist_ok=True)


def read_run(path: Path) -> None:
    """What `status`, `verify`, `calibrate`, `export`, the report and `--resume` read of a run. Refusals of the
    parts are told together: each must name a file of the run."""
    from coupole.acquisition.conclusion import renew_report
    from coupole.calibration.light.frames import open_light_frames
    from coupole.calibration.sources import open_sources
    from coupole.exchange.export import export_run
    from coupole.storage.run import Run
    from coupole.storage.run_status import status
    from coupole.storage.verification import verify

    folder = path.parent.parent if path.parent.name == "views" else path.parent
    run = Run(folder)
    readers = (
        lambda: status(run).figures(),
        lambda: verify(run),
        run.occupied_space,
        run.refuse_old_journal,
        lambda: [frame.read() for frame in open_light_frames([folder]).lit],
        lambda: export_run(run, "tiff", folder.parent / "exported", overwrite=True),
        lambda: open_sources([folder], None),
        lambda: renew_report(run),
    )
    for read in readers:
        told = refusal(read)
        assert not told or str(folder) in told, f"names no file: {told}"


def archive_view(path: Path) -> None:
    """`coupole archive` of the run, in a copy that it may change."""
    from coupole.storage.archive import archive_run
    from coupole.storage.bitshuffle import codec_of
    from coupole.storage.run import Run

    with tempfile.TemporaryDirectory() as folder:
        run = shutil.copytree(path.parent.parent, Path(folder) / "run")
        archive_run(Run(run), codec_of("lz4"))


def read_record_of(path: Path) -> None:
    """As it is, and once more with a seal that fits: what is wrong inside must be found too."""
    from ruamel.yaml import YAML, YAMLError

    from coupole.calibration.record import content_sha256, read_record

    told = refusal(lambda: read_record(path))
    assert not told or path.name in told
    if "aliases" in told:
        return  # that stand for more than can be written out here
    try:
        plain = YAML(typ="safe", pure=True).load(path.read_bytes().decode())
        plain["sha256"] = content_sha256(json.loads(json.dumps(plain, default=str)))
        path.write_text(json.dumps(plain, default=str))
    except (YAMLError, ValueError, TypeError, AttributeError, RecursionError):
        return
    told = refusal(lambda: read_record(path))
    assert not told or path.name in told


def records() -> list[bytes]:
    return [(WITNESS / "records/dark.yaml").read_bytes()]


def record_beside(folder: Path) -> None:
    shutil.copy(WITNESS / "records/dark.h5", folder)


def lines_of(*lines: str) -> Callable[[], list[bytes]]:
    return lambda: [("\n".join(lines) + "\n").encode()]


LEDGER = lines_of(
    '{"event": "planned", "t": "2026-11-22T07:02:21.024Z", "id": "a", "run": "r", "dose_lux_h": 1.5}',
    '{"event": "given", "t": "2026-11-22T07:02:22.024Z", "id": "a", "dose_lux_h": 1.25}',
    '{"event": "dose", "t": "2026-11-22T07:02:23.024Z", "dose_lux_h": 12, "note": "3 lamps"}',
)
ARM_FAULTS = lines_of(
    '{"event": "fault", "t": "2026-11-22T07:02:21.024Z", "message": "10 mm off", "run": "r"}',
    '{"event": "session", "t": "2026-11-22T07:02:22.024Z", "run": "r"}',
)
RESULT = lines_of(
    '{"schema": "coupole-reflectance-run/1", "software": {"coupole": "1"}, "runs": {"a": 1}, "mae": {"b": 0.5},',
    ' "emission": "lambertian", "scan_noise_um": 12, "simulated": true}',
)
PICTURES = lines_of('{"schema": "coupole-reflectance-pictures/1", "pictures": 3, "noise": [0.5, 12]}')
QUEUE = lines_of('{"halted": "", "entries": [{"id": "1", "by": "a", "entered": "2026", "begun": "3"}]}')


def read_ledger(path: Path) -> None:
    from coupole.storage.ledger import Ledger

    Ledger(path.parent, path.stem).read_history()


def read_arm_faults(path: Path) -> None:
    from coupole.storage.arm_faults import ArmFaults

    ArmFaults(path.parent).standing()


def read_result(path: Path) -> None:
    from coupole.reflectance.run_result import read_about

    read_about(path.parent)


def read_pictures(path: Path) -> None:
    from coupole.reflectance.picture_result import PictureResult

    _ = PictureResult(path.parent).about


def read_queue(path: Path) -> None:
    from coupole.console.plans.plan_queue import PlanQueue

    PlanQueue(path)


KEPT = (
    Target("ledger", "ledgers/case.jsonl", LEDGER, read_ledger),
    Target("arm-faults", "states/arm.jsonl", ARM_FAULTS, read_arm_faults),
    Target("result", "results/result.json", RESULT, read_result),
    Target("pictures", "pictures/result.json", PICTURES, read_pictures),
    Target("queue", "queues/queue.json", QUEUE, read_queue),
    Target("run-json", "runs/a/run.json", seeds("run.json"), read_run, run_beside),
    Target("journal", "runs/b/journal.jsonl", seeds("journal.jsonl"), read_run, run_beside),
    Target("manifest", "runs/c/manifest.sha256", seeds("manifest.sha256"), read_run, run_beside),
    Target("view", "runs/d/views/top.h5", seeds("views/top.h5"), read_run, run_beside),
    Target("archived-view", "runs/e/views/top.h5", seeds("views/top.h5"), archive_view, run_beside),
    Target("record", "records/case.yaml", records, read_record_of, record_beside),
)
