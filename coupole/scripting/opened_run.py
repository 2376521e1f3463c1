"""A run read from Python: its views, and proven frames as numpy arrays. A frame is read when its pixels are
used."""

from __future__ import annotations

import difflib
import os
from collections.abc import Iterable, Iterator, Mapping
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from coupole.errors import InputError
from coupole.plan.reading import read_plan
from coupole.plan.shot_id import Led
from coupole.scripting.proven_frame import Frame
from coupole.storage.journal_events import FrameProven
from coupole.storage.run import Run as RunFolder
from coupole.storage.step_fields import board_temperature_c
from coupole.storage.view_reader import View as ViewFile
from coupole.storage.view_reader import read_view

if TYPE_CHECKING:
    import xarray as xr


class RunView(Mapping[str, Frame]):
    """Proven frames of one view by their labels (`led0417/e0`), in the order of the journal."""

    name: str
    """Name of the view."""

    def __init__(self, name: str, frames: Mapping[str, FrameProven], run: Run) -> None:
        self.name, self._events, self._run = name, frames, run

    def __getitem__(self, label: str) -> Frame:
        """Return the frame of this label. Raises KeyError with similar labels if there is no such proven frame."""
        self._run._refuse_closed()
        if label not in self._events:
            raise _unknown(label, self._events, f"proven frame of the view {self.name}")
        return self._frame(self._events[label])

    def __iter__(self) -> Iterator[str]:
        return iter(self._events)

    def __len__(self) -> int:
        return len(self._events)

    def __repr__(self) -> str:
        return f"<view {self.name}: {len(self)} proven frames>"

    @property
    def shots(self) -> tuple[str, ...]:
        """Labels of the proven frames under a light; dark frames and marks are left out."""
        return tuple(label for label, event in self._events.items() if event.shot.is_shot)

    @property
    def darks(self) -> tuple[str, ...]:
        """Labels of the proven dark frames, including the dark marks at the ends of bursts."""
        return tuple(label for label, event in self._events.items() if event.shot.is_dark)

    @property
    def pattern(self) -> str:
        """Bayer pattern of the 2 x 2 pixels from the top left, or MONO."""
        return self._file.pattern

    @property
    def black_dn(self) -> int:
        """Value of a pixel without light, DN."""
        return self._file.black_dn

    @property
    def white_dn(self) -> int:
        """Greatest value of a pixel, DN."""
        return self._file.white_dn

    @property
    def pixel_mm(self) -> float | None:
        """Nominal size of a pixel on the plane in focus, mm, by the rig's lens; None if the file names no lens."""
        names = ("pixel_pitch_um", "focal_length_mm", "focus_distance_mm")
        pitch_um, focal_mm, focus_mm = (self._file.number(name) for name in names)
        if not pitch_um or not focal_mm or not focus_mm or focus_mm <= focal_mm:
            return None
        return pitch_um * 1e-3 * (focus_mm - focal_mm) / focal_mm

    @cached_property
    def _file(self) -> ViewFile:
        paths = {self._run.folder / event.file for event in self._events.values()}
        if not paths:
            raise InputError(f"{self._run.folder}: the view {self.name} has no proven frame")
        return read_view(paths.pop(), self._events.values())

    def _frame(self, event: FrameProven) -> Frame:
        record = self._file.records[event.index]
        pose = self._file.poses[record["pose"]]
        led = event.shot.light.id if isinstance(event.shot.light, Led) else None
        return Frame(
            str(event.shot),
            self.name,
            str(event.shot.label),
            led,
            None if led is None else self._run._led_positions_mm.get(led),
            int(record["exposure_us"]),
            event.shot.is_dark,
            pose["base_from_camera"].copy(),
            pose["joints_deg"].copy(),
            board_temperature_c(record),
            event.t,
            self._run.proof,
            event.xxh3,
            self._file,
            event,
        )


class Run(Mapping[str, RunView]):
    """A run folder: its views by their names. It contains only frames that the journal had proven when it was
    opened."""

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self._run = RunFolder(Path(path))
        self._closed = False
        by_view: dict[str, dict[str, FrameProven]] = {name: {} for name in self._run.views}
        for shot, event in self._run.proven().items():
            by_view.setdefault(shot.view, {})[str(shot.label)] = event
        self._views = {name: RunView(name, events, self) for name, events in by_view.items()}

    def __enter__(self) -> Run:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Forget the run; frames that were obtained from it can still be read."""
        self._closed = True

    def __getitem__(self, view: str) -> RunView:
        """Return the view of this name. Raises KeyError with similar names if the run has no such view."""
        self._refuse_closed()
        if view not in self._views:
            raise _unknown(view, self._views, "view")
        return self._views[view]

    def __iter__(self) -> Iterator[str]:
        return iter(self._views)

    def __len__(self) -> int:
        return len(self._views)

    def __repr__(self) -> str:
        return f"<run {self.folder.name}: {', '.join(map(repr, self._views.values()))}>"

    @property
    def folder(self) -> Path:
        """The run's folder, absolute."""
        return self._run.folder

    @property
    def views(self) -> tuple[str, ...]:
        """Names of the views, in the order of the plan, or in the order of the choices if views are chosen in the
        run.
        """
        return tuple(self._views)

    @property
    def about(self) -> Mapping[str, Any]:
        """Contents of run.json: software, operator, devices, inputs."""
        return self._run.about

    @property
    def is_simulated(self) -> bool:
        """True if its frames come from a simulated cell."""
        return self._run.is_simulated

    @property
    def proof(self) -> str:
        """How the identity of the run's frames was proven, in the words of run.json."""
        return self._run.proof

    @property
    def missing(self) -> tuple[str, ...]:
        """Ids of the plan's shots and dark frames that are not proven. If frames are chosen in the run, only those
        chosen so far count (see `open_views`)."""
        proven = self._run.proven()
        return tuple(str(shot) for shot in self._run.expected_shots() if shot not in proven)

    @property
    def open_views(self) -> tuple[str, ...]:
        """Views for which more frames may still be chosen; none if the plan names all frames."""
        return tuple(self._run.open_views())

    @property
    def wants_views(self) -> bool:
        """True if more views may yet be chosen; False where the plan names all views."""
        return self._run.wants_views

    def dataset(self, view: str) -> xr.Dataset:
        """All proven frames of a view as an xarray Dataset on dask. `pixels` is [shot, y, x] uint16 DN, with a
        chunk for each frame, which is read when it is computed. Coordinates are the attributes of `Frame`; units
        are in `attrs`.

        Raises KeyError if there is no such view, ModuleNotFoundError if the extra `xarray` is not installed.
        """
        from coupole.scripting.view_dataset import dataset_of

        run_view = self[view]
        facts = {"black_dn": run_view.black_dn, "white_dn": run_view.white_dn, "pattern": run_view.pattern}
        facts |= {"view": view, "proof": self.proof, "simulated": int(self.is_simulated)}
        return dataset_of(list(run_view.values()), facts)

    def _refuse_closed(self) -> None:
        if self._closed:
            raise ValueError(f"{self.folder}: the run was closed")

    @cached_property
    def _led_positions_mm(self) -> dict[int, NDArray[np.float64]]:
        files = read_plan(self._run.plan_path, self._run.rig_path)
        positions = _calibrated_positions(files.record_paths or ())
        ids, positions_mm = positions or (files.cell.leds.ids, files.cell.leds.positions_mm)
        return dict(zip(map(int, ids), positions_mm, strict=True))


def open_run(path: str | os.PathLike[str]) -> Run:
    """Open a run folder for reading, also while it is being acquired.

    `path` is the folder that `coupole acquire` made. Raises InputError if the folder is not a run, StorageError if
    its journal or a view's file is damaged.
    """
    return Run(path)


def _calibrated_positions(record_paths: Iterable[Path]) -> tuple[NDArray[np.int64], NDArray[np.float64]] | None:
    """Return ids and positions [n, 3] of the LEDs, mm, from the record of the kind `leds`; None if no such record
    is named."""
    from coupole.calibration.in_force import read_in_force
    from coupole.calibration.light.led_power_tile import calibrated_positions

    for item in read_in_force(tuple(record_paths)):
        if item.record.kind == "leds":
            positions = calibrated_positions(item.path)
            return positions.ids, positions.centres_mm
    return None


def _unknown(name: str, known_names: Iterable[str], kind: str) -> KeyError:
    names = list(known_names)
    near = difflib.get_close_matches(name, names, n=3) or names[:3]
    return KeyError(f"there is no {kind} {name!r}; near names: {', '.join(near) or 'none'}")
