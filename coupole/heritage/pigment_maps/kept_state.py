"""State of a long job in a folder, so that a job that was interrupted continues.

The state belongs to one question, whose key it keeps. It is deleted when the job is done, or if another question
is asked.
"""

from __future__ import annotations

import io
import shutil
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
from numpy.typing import NDArray

from coupole.errors import StorageError, reason
from coupole.storage.durable import make_folder, write_synced

_KEY = "question"


class KeptState:
    """Arrays by the name of a step, and maps that are filled row by row. All methods raise StorageError."""

    def __init__(self, folder: Path, key: str) -> None:
        self._folder = folder
        try:
            key_file = folder / _KEY
            if folder.is_dir() and not (key_file.is_file() and key_file.read_text(encoding="utf-8") == key):
                shutil.rmtree(folder)
            make_folder(folder)
            write_synced(key_file, key)
        except OSError as error:
            raise self._error(error) from error

    def load(self, step: str) -> dict[str, NDArray[Any]] | None:
        """The arrays that were kept of a step; None if there are none."""
        path = self._folder / f"{step}.npz"
        if not path.is_file():
            return None
        try:
            with np.load(path, allow_pickle=False) as arrays:
                return {name: arrays[name] for name in arrays.files}
        except (OSError, ValueError, BadZipFile) as error:
            raise self._error(error) from error

    def save(self, step: str, **arrays: Any) -> None:
        """Keep arrays of a step instead of those before."""
        buffer = io.BytesIO()
        np.savez(buffer, **arrays)
        try:
            write_synced(self._folder / f"{step}.npz", buffer.getvalue())
        except OSError as error:
            raise self._error(error) from error

    def map(self, name: str, shape: tuple[int, ...], dtype: type[np.generic]) -> NDArray[Any]:
        """A map on the disk, zero where nothing was written yet."""
        path = self._folder / f"{name}.npy"
        try:
            if path.is_file():
                return np.lib.format.open_memmap(path, mode="r+")
            partial = path.with_suffix(".part")
            pixel_map = np.lib.format.open_memmap(partial, mode="w+", dtype=dtype, shape=shape)
            partial.replace(path)
        except (OSError, ValueError) as error:
            raise self._error(error) from error
        return pixel_map

    def remove(self) -> None:
        """Delete the state: the job is done."""
        shutil.rmtree(self._folder, ignore_errors=True)

    def _error(self, error: Exception) -> StorageError:
        return StorageError(
            f"{self._folder}: {reason(error)}; free space on its disk, or delete this folder to begin again"
        )
