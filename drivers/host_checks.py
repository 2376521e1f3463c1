"""Drivers' needs of the machine on which they run, checked without touching a device."""

from __future__ import annotations

import ctypes
import errno
import grp
import importlib.util
import os
import socket
import stat
from pathlib import Path

from coupole.devices import HostNeed

LEAST_RECEIVE_BUFFER_BYTES = 32 * 2**20
"""Least receive buffer: the kernel's memory for a packed frame of 12 megapixels in packets of 1500 bytes."""
_RECEIVE_LIMIT = Path("/proc/sys/net/core/rmem_max")
_HUGE_PAGES = Path("/sys/kernel/mm/transparent_hugepage/enabled")


def serial_port(port: str) -> list[HostNeed]:
    """Check a port of the machine: it exists, and this user may use it. Addresses such as `socket://` have no
    needs."""
    if "://" in port or port.startswith("usbtmc:"):
        return []
    path, what = Path(port), f"serial port {port}"
    try:
        mode = path.stat()
    except OSError as error:
        remedy = "Connect the box and look at `ls /dev/serial/by-id`; correct `port` in the rig."
        return [HostNeed(what, False, error.strerror or str(error), remedy)]
    if not stat.S_ISCHR(mode.st_mode):
        return [HostNeed(what, False, "is no device", "Correct `port` in the rig.")]
    if os.access(path, os.R_OK | os.W_OK):
        return [HostNeed(what, True, "is there and may be used", "")]
    remedy = f"Run `sudo usermod -aG {_group_name(mode.st_gid)} $USER`, and log in again."
    return [HostNeed(what, False, "this user may not use it", remedy)]


def _group_name(number: int) -> str:
    try:
        return grp.getgrgid(number).gr_name
    except KeyError:
        return str(number)


def package(name: str, extra: str) -> HostNeed:
    """A Python package that an extra installs."""
    try:
        is_installed = importlib.util.find_spec(name) is not None
    except ImportError:
        is_installed = False
    remedy = f"Install it: pip install 'coupole[{extra}]'."
    return HostNeed(f"Python package {name}", is_installed, "installed" if is_installed else "missing", remedy)


def library(name: str, remedy: str) -> HostNeed:
    """A shared library by its name or path."""
    try:
        ctypes.CDLL(name)
    except OSError as error:
        return HostNeed(f"library {name}", False, str(error), remedy)
    return HostNeed(f"library {name}", True, "can be loaded", "")


def library_file(path: Path) -> HostNeed:
    """A GenTL producer by its path."""
    what, is_there = f"GenTL producer {path}", path.is_file()
    folders = os.environ.get("GENICAM_GENTL64_PATH") or "not set"
    remedy = f"Install the camera maker's software, and name its .cti (GENICAM_GENTL64_PATH is {folders})."
    return HostNeed(what, is_there, "is there" if is_there else "there is no such file", remedy)


def folder_of_pictures(path: Path) -> HostNeed:
    """A folder in which another program writes."""
    is_there = path.is_dir() and os.access(path, os.R_OK | os.X_OK)
    state = "can be read" if is_there else "cannot be read" if path.exists() else "there is no such folder"
    return HostNeed(
        f"folder {path}", is_there, state, "Start the tethering program, or correct `folder` in the rig."
    )


def own_address(address: str, *, kind: socket.SocketKind) -> list[HostNeed]:
    """Check an address host:port at which a driver listens: this machine has it, and the port is free. Port 0 has
    no needs, because any free port serves."""
    host, port = address.rsplit(":", 1)
    if port == "0":
        return []
    what = f"address {address} to listen at"
    with socket.socket(socket.AF_INET, kind) as probe:
        try:
            probe.bind((host, int(port)))
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                remedy = "End the other program (`ss -lptu`), or choose another port here and at the controller."
                return [HostNeed(what, False, "another program has this port", remedy)]
            remedy = f"Give the interface to the controller the address {host}, or correct the rig."
            return [
                HostNeed(what, False, f"no interface of this machine has this address ({error.strerror})", remedy)
            ]
    return [HostNeed(what, True, "is this machine's, and free", "")]


def receive_buffer() -> HostNeed:
    """Check the kernel's limit for a socket that receives frames."""
    limit_bytes, least = _number(_RECEIVE_LIMIT), f"{LEAST_RECEIVE_BUFFER_BYTES >> 20} MB"
    remedy = "Run `sudo sysctl -w net.core.rmem_max=67108864` (and write it into /etc/sysctl.d)."
    return HostNeed(
        "receive buffer of the network",
        limit_bytes >= LEAST_RECEIVE_BUFFER_BYTES,
        f"at most {limit_bytes / 2**20:.1f} MB (net.core.rmem_max), {least} are needed",
        remedy,
        is_vital=False,
    )


def huge_pages() -> HostNeed:
    """Check transparent huge pages for buffers of frames."""
    try:
        words = _HUGE_PAGES.read_text()
    except OSError:
        words = "unknown"
    chosen = words[words.find("[") + 1 : words.find("]")] if "[" in words else words.strip()
    remedy = f"Run `echo madvise | sudo tee {_HUGE_PAGES}`."
    return HostNeed("transparent huge pages", chosen in ("madvise", "always"), chosen, remedy, is_vital=False)


def _number(path: Path) -> int:
    try:
        return int(path.read_text())
    except (OSError, ValueError):
        return 0
