"""Mitsuba, if it is there, in the variant that this machine can run."""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib
import os
from typing import Any

from coupole.errors import InputError

_LEAST_LLVM = 19
"""LLVM 15 and 16 abort the interpreter (facts on materials); they are never tried."""


def mitsuba(variant: str) -> Any:
    """The module, set to `variant`. Raises InputError if it is not installed."""
    try:
        module = importlib.import_module("mitsuba")
    except ImportError as error:
        raise InputError(
            f"spectral rendering: expected Mitsuba 3 with colour-science; {error}. "
            "Install them: pip install 'coupole[mitsuba,materials]'"
        ) from error
    module.set_variant(variant)
    return module


def spectral(*, polarised: bool) -> str:
    """Name of the spectral variant: compiled by LLVM where there is one that works, scalar elsewhere."""
    kind = "llvm_ad" if llvm_version() >= _LEAST_LLVM else "scalar"
    return f"{kind}_spectral_polarized" if polarised else f"{kind}_spectral"


def llvm_version() -> int:
    """Major version of the LLVM library that Dr.Jit would load; 0 if there is none, or if it does not say."""
    name = os.environ.get("DRJIT_LIBLLVM_PATH") or ctypes.util.find_library("LLVM")
    if not name:
        return 0
    try:
        library = ctypes.CDLL(name)
        numbers = [ctypes.c_uint() for _ in range(3)]
        library.LLVMGetVersion(*map(ctypes.byref, numbers))
    except (OSError, AttributeError):  # AttributeError: LLVMGetVersion is younger than LLVM 15
        return 0
    return int(numbers[0].value)
