"""Which variant of Mitsuba is taken."""

from __future__ import annotations

from pathlib import Path

import pytest

from coupole.appearance.render.variant import LEAST_LLVM, llvm_version, spectral


@pytest.mark.parametrize(
    ("name", "version"),
    [
        ("libLLVM-15.so.1", 15),
        ("libLLVM.so.19.1", 19),
        ("/usr/lib/libLLVM-20.so", 20),
        ("libLLVM.20.dylib", 20),
        ("LLVM-C.dll", 0),
        ("libLLVM.so", 0),
        ("", 0),
    ],
)
def test_the_version_of_llvm_is_read_from_its_files_name(name: str, version: int) -> None:
    assert llvm_version(name) == version


def test_links_to_llvm_are_followed(tmp_path: Path) -> None:
    (tmp_path / "libLLVM.so.19.1").touch()
    (tmp_path / "libLLVM.so").symlink_to(tmp_path / "libLLVM.so.19.1")
    assert llvm_version(str(tmp_path / "libLLVM.so")) == 19


def test_an_old_llvm_is_never_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DRJIT_LIBLLVM_PATH", f"libLLVM-{LEAST_LLVM - 1}.so.1")
    assert spectral(is_polarised=False) == "scalar_spectral"
    assert spectral(is_polarised=True) == "scalar_spectral_polarized"
