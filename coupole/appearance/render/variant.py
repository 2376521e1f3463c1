"""Imports Mitsuba, if installed, in a variant that this machine supports."""

from __future__ import annotations

import ctypes.util
import importlib
import os
import re
from pathlib import Path
from typing import Any

from coupole.errors import InputError

LEAST_LLVM = 19
"""Least version of LLVM: versions 15 and 16 abort the interpreter, so they are not tried."""


def mitsuba(variant: str) -> Any:
    """Return Mitsuba's module, set to `variant`. Raises InputError if it is not installed."""
    module = import_extra("mitsuba")
    module.set_variant(variant)
    return module


def load_scene(mi: Any, description: Any) -> Any:
    """Return Mitsuba's scene from a description, with lights in the given order.

    With parallel loading, or merging of equal parts, the order of lights would vary, and their random numbers too.
    """
    return mi.load_dict(description, parallel=False, optimize=False)


def import_extra(name: str, extra: str = "mitsuba,materials") -> Any:
    """Import an optional module. If the module is not installed, raises InputError that names the extra with
    it."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"spectral rendering: expected {name}; {error}. Install it: pip install 'coupole[{extra}]'"
        ) from error


def spectral(*, is_polarised: bool) -> str:
    """Return the name of the spectral variant: LLVM if a suitable library is found, otherwise scalar."""
    library = os.environ.get("DRJIT_LIBLLVM_PATH") or ctypes.util.find_library("LLVM") or ""
    kind = "scalar"
    if llvm_version(library) >= LEAST_LLVM:
        kind = "llvm_ad"
        os.environ["DRJIT_LIBLLVM_PATH"] = library  # Dr.Jit's own search might find another library
    return f"{kind}_spectral_polarized" if is_polarised else f"{kind}_spectral"


def llvm_version(library: str) -> int:
    """Return the major version of an LLVM library from its file name, after following links; 0 if unknown.

    The library is not loaded, because an old one would abort the process.
    """
    version_match = re.search(r"LLVM(?:-|\.so\.|\.)(\d+)", Path(library).resolve().name)
    return int(version_match.group(1)) if version_match else 0
