"""The cell's needs of the machine that runs it. These needs are checked without the cell's devices (`coupole
doctor`).
"""

from __future__ import annotations

import errno
import os
import resource
import shutil
from pathlib import Path

from coupole.devices import HostNeed
from coupole.errors import ResourceShortage
from coupole.plan.cell import Cell
from coupole.plan.rig_devices import host_needs

ROOM_BYTES = 20_400_000_000
"""Size of one view under 1080 LEDs: frames of 12 megapixels, 12 bits packed."""

_USED_UP = 0.9
"""A process that has more than this share of its limit may fail because of it."""
LEAST_ADDRESS_SPACE_BYTES = 2_500_000_000
"""Least address space that a plan may be read with. The demo's run took 2.0 GB of it, most of it compiled code and
libraries. Embree ends the process with a segmentation fault where it gets none."""


def refuse_little_address_space() -> None:
    """Raises ResourceShortage if this process is limited to less than LEAST_ADDRESS_SPACE_BYTES (`ulimit -v`)."""
    if why := little_address_space():
        raise ResourceShortage(f"{why}. Raise the limit (`ulimit -v unlimited`).")


def little_address_space(pid: int = 0) -> str:
    """Return why a process of this user (0: this one) has too little memory: it is limited to less than
    LEAST_ADDRESS_SPACE_BYTES (`ulimit -v`, `prlimit --as`). Empty if its limit is not lower, or if there is no
    such process."""
    try:
        limit_bytes, _ = resource.prlimit(pid, resource.RLIMIT_AS)
    except OSError:
        return ""
    if limit_bytes == resource.RLIM_INFINITY or limit_bytes >= LEAST_ADDRESS_SPACE_BYTES:
        return ""
    process = f"process {pid}" if pid else "this process"
    return (
        f"{process} may have {limit_bytes / 1e9:.2f} GB of address space; a plan needs "
        f"{LEAST_ADDRESS_SPACE_BYTES / 1e9:.1f} GB, and large frames need more"
    )


def memory_behind(error: BaseException) -> str:
    """Return why this process had too little memory for what raised an error; empty if this is not known. A
    library that gets no memory may raise any error; then the limit of memory is used up."""
    link: BaseException | None = error
    while link is not None:
        if isinstance(link, MemoryError) or (isinstance(link, OSError) and link.errno == errno.ENOMEM):
            return little_address_space(os.getpid()) or "this process was given no more memory"
        link = link.__cause__ or link.__context__
    why = little_address_space(os.getpid())
    limit_bytes, _ = resource.getrlimit(resource.RLIMIT_AS)
    return why if why and _address_space_bytes() > _USED_UP * limit_bytes else ""


def _address_space_bytes() -> int:
    """Return the address space that this process has."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[0])
    return pages * os.sysconf("SC_PAGE_SIZE")


def machine_needs(cell: Cell) -> list[tuple[str, HostNeed]]:
    """Return the needs of the rig's drivers and of its storage, each with the part of the rig that needs it."""
    return [*host_needs(cell.rig), *(("storage", need) for need in storage_needs(cell.storage_folder))]


def storage_needs(folder: Path) -> list[HostNeed]:
    """Return the needs of a folder of runs: it must be writable and have room."""
    there = next(path for path in (folder, *folder.absolute().parents) if path.exists())
    need_name = f"folder of runs {folder}"
    if not there.is_dir():
        return [HostNeed(need_name, False, f"{there} is no folder", "Name another folder in the rig.")]
    if not os.access(there, os.W_OK | os.X_OK):
        return [
            HostNeed(need_name, False, f"this user may not write into {there}", f"Run `sudo chown $USER {there}`.")
        ]
    free_bytes = shutil.disk_usage(there).free
    remedy = "Archive or move older runs (`coupole archive`), or name another folder in the rig."
    room = HostNeed(
        "room for runs", free_bytes >= ROOM_BYTES, f"{free_bytes / 1e9:.0f} GB free", remedy, is_vital=False
    )
    return [HostNeed(need_name, True, "can be written", ""), room]
