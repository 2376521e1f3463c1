"""Samples of views, taken during an acquisition, before the rest of the run was known.

A result is begun with the frames of all its views (`result_folder.begin`). For samples that were taken before, a
note for each view names the frames that they depend on, and the LEDs kept for the check. When the run is complete,
samples that agree with it are used, and the others are taken again.
"""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import coupole
from coupole.calibration.light.frames import LightFrames
from coupole.errors import InputError
from coupole.intake.plain_data import read_json
from coupole.reflectance.discarded_frames import refuse_stale
from coupole.reflectance.result_folder import SETTINGS, read_settings
from coupole.reflectance.run_result import FRAMES
from coupole.storage import so_far
from coupole.storage.durable import make_folder, write_synced
from coupole.storage.processing import FOLDER, refuse_held

_NOTES = f"{FOLDER}/samples.json"
_DECIDE = ("records", "mesh", "refined", "emission", "simulated", "channels")
"""Settings of a result that its samples depend on."""


@dataclass(frozen=True)
class ViewBasis:
    """Frames and LEDs that a view's samples depend on, besides mesh and records."""

    frames: str
    """Hash of the frames of the view and of the views before it, because their dark frames are used too."""
    left_out: tuple[int, ...]
    """LEDs kept for the check, whose pictures are written with the samples."""


def frames_basis(frames: LightFrames, view: str) -> str:
    """Hash of the frames that the samples of a view depend on."""
    lines = [f"{name} {digest}" for name, digest in frames.until(view).inputs if "/views/" in name]
    return hashlib.sha256("\n".join(lines).encode()).hexdigest()


def is_of_run(out: Path, run: str) -> bool:
    """Tell, by the run's name, whether the result in a folder belongs to this run and to no other. Raises
    InputError for a folder whose files cannot be read."""
    if (out / SETTINGS).exists():
        return list(read_settings(out)["runs"]) == [run]
    notes = _read_notes(out)
    return (out / FOLDER).is_dir() if notes is None else notes["run"] == run


def note_view(out: Path, run: str, settings: Mapping[str, Any], file_name: str, basis: ViewBasis) -> None:
    """Note the inputs of a view's samples, before the samples are taken. Raises InputError if the folder has
    samples of another run or with other settings, and OSError."""
    notes = _read_notes(out)
    decisive = _decisive(settings)
    if notes is None:
        notes = {"run": run, "settings": decisive, "views": {}}
    elif (notes["run"], notes["settings"]) != (run, decisive):
        raise InputError(_of_others(out))
    notes["views"][file_name] = {"frames": basis.frames, "left_out": list(basis.left_out)}
    for name in ("samples", FOLDER):
        make_folder(out / name)
    write_synced(out / _NOTES, json.dumps(notes) + "\n")


def is_taken(out: Path, file_name: str, basis: ViewBasis) -> bool:
    """Tell whether the samples of a view are there, and agree with its present frames."""
    notes = _read_notes(out)
    view_notes = None if notes is None else notes["views"].get(file_name)
    return (
        view_notes is not None
        and view_notes["frames"] == basis.frames
        and (out / "samples" / f"{file_name}.json").exists()
    )


def adopt(
    out: Path, settings: Mapping[str, Any], bases: Mapping[str, ViewBasis], discarded_names: Collection[str]
) -> None:
    """Keep the samples from the acquisition that are valid for the complete run, and remove the others. `bases`
    holds the basis of each view by the name of its file. Raises InputError if the samples were made from other
    input, if a process works on them, or if they are not valid and the frames of their view were discarded
    (`discarded_names`).
    """
    if not (out / FOLDER).is_dir():
        return
    refuse_held(out)
    if (out / SETTINGS).exists():
        return
    notes = _read_notes(out)
    if notes is not None and notes["settings"] != _decisive(settings):
        raise InputError(_of_others(out))
    known_views = {} if notes is None else notes["views"]
    for path in (out / "samples").glob("*.h5"):
        view_notes, basis = known_views.get(path.stem), bases.get(path.stem)
        picture = out / FRAMES / path.name
        if view_notes is None or basis is None or view_notes["frames"] != basis.frames:
            refuse_stale(discarded_names, path.stem, out)
            for stale in (path.with_suffix(".json"), path, picture):  # the first says that the others are whole
                stale.unlink(missing_ok=True)
        elif tuple(view_notes["left_out"]) != basis.left_out:
            refuse_stale(discarded_names, path.stem, out)
            picture.unlink(missing_ok=True)


def clear_beside(out: Path) -> None:
    """Remove the files that are needed only until the result is complete."""
    so_far.remove(out)
    shutil.rmtree(out / FOLDER, ignore_errors=True)


def _decisive(settings: Mapping[str, Any]) -> dict[str, Any]:
    return {"software": coupole.__version__, "poses": settings.get("poses")} | {
        name: settings[name] for name in _DECIDE
    }


def _of_others(out: Path) -> str:
    return f"{out} holds samples of other input, settings or version: name another folder, or remove it"


def _read_notes(out: Path) -> dict[str, Any] | None:
    """Read the notes; None if nothing was noted."""
    path = out / _NOTES
    try:
        notes = read_json(path)
    except FileNotFoundError:
        return None
    except OSError as error:
        raise InputError(f"{path}: cannot be read: {error.strerror}") from error
    if not isinstance(notes, dict) or not {"run", "settings", "views"} <= notes.keys():
        raise InputError(f"{path}: expected notes on samples; was it changed? Remove {out}, then begin anew")
    return notes
