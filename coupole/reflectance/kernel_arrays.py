"""Assignment of arrays in compiled code.

Numba compiles `a[:] = b` with an error message about shapes that do not fit. This message and its formatting take
two seconds to compile, and are optimised again in each kernel that contains them.
"""

from __future__ import annotations

from coupole.kernels import kernel


@kernel
def assign(to, values):  # type: ignore[no-untyped-def]
    """Copy the numbers `values` [n] to `to` [n]; the lengths are not checked."""
    for n in range(len(to)):
        to[n] = values[n]


@kernel
def assign_rows(to, values):  # type: ignore[no-untyped-def]
    """Copy the numbers `values` [m, n] to `to` [m, n]; the shapes are not checked."""
    for row in range(to.shape[0]):
        for column in range(to.shape[1]):
            to[row, column] = values[row, column]
