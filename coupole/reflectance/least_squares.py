"""Many small regularised least-squares problems, one after the other in compiled code, by SciPy's BLAS and LAPACK.

The caller must turn off the threads of BLAS (`one_thread`), because whole problems are solved in parallel.
"""

from __future__ import annotations

import functools
from typing import Any

import llvmlite.binding
import numpy as np
from numba import types
from numba.extending import get_cython_function_address
from threadpoolctl import ThreadpoolController

from coupole.kernels import kernel
from coupole.reflectance.kernel_arrays import assign_rows

_INT, _DOUBLE, _CHAR = map(types.CPointer, (types.intc, types.float64, types.uint8))


def _routine(module: str, name: str, *kinds: Any) -> Any:
    """Return a Fortran routine that compiled code may call. It is called by name, so functions that call it can be
    cached.
    """
    symbol = f"coupole_{name}"
    llvmlite.binding.add_symbol(symbol, get_cython_function_address(f"scipy.linalg.cython_{module}", name))
    return types.ExternalFunction(symbol, types.void(*kinds))


_dsyrk = _routine("blas", "dsyrk", _CHAR, _CHAR, _INT, _INT, _DOUBLE, _DOUBLE, _INT, _DOUBLE, _DOUBLE, _INT)
_dgemm = _routine(
    "blas", "dgemm", _CHAR, _CHAR, _INT, _INT, _INT, _DOUBLE, _DOUBLE, _INT, _DOUBLE, _INT, _DOUBLE, _DOUBLE, _INT
)
_dpotrf = _routine("lapack", "dpotrf", _CHAR, _INT, _DOUBLE, _INT, _INT)
_dpotrs = _routine("lapack", "dpotrs", _CHAR, _INT, _INT, _DOUBLE, _INT, _DOUBLE, _INT, _INT)
_dtrsm = _routine("blas", "dtrsm", _CHAR, _CHAR, _CHAR, _CHAR, _INT, _INT, _DOUBLE, _DOUBLE, _INT, _DOUBLE, _INT)


def one_thread() -> Any:
    """Context in which BLAS uses one thread for each call."""
    return _libraries().limit(limits=1, user_api="blas")


@functools.cache
def _libraries() -> ThreadpoolController:
    """Return the libraries that this process has loaded, among them the BLAS of NumPy and of SciPy. They are
    searched once."""
    return ThreadpoolController()


@kernel
def gram(rows, product):  # type: ignore[no-untyped-def]
    """Fill `product` [n, n] with rows rows^T of `rows` [n, samples]: the half that `factorise` reads."""
    upper, transpose = np.array([85], np.uint8), np.array([84], np.uint8)  # U and T
    sizes = np.array([rows.shape[0], rows.shape[1]], np.intc)
    factors = np.array([1.0, 0.0])
    _dsyrk(
        upper.ctypes, transpose.ctypes, sizes.ctypes, sizes[1:].ctypes, factors.ctypes, rows.ctypes,
        sizes[1:].ctypes, factors[1:].ctypes, product.ctypes, sizes.ctypes,
    )  # fmt: skip


@kernel
def sums(rows, values, right):  # type: ignore[no-untyped-def]
    """Fill `right` [m, n] with values rows^T of `values` [m, samples] and `rows` [n, samples]."""
    transpose, plain = np.array([84], np.uint8), np.array([78], np.uint8)  # T and N
    sizes = np.array([len(rows), len(values), rows.shape[1]], np.intc)
    factors = np.array([1.0, 0.0])
    _dgemm(
        transpose.ctypes, plain.ctypes, sizes.ctypes, sizes[1:].ctypes, sizes[2:].ctypes, factors.ctypes,
        rows.ctypes, sizes[2:].ctypes, values.ctypes, sizes[2:].ctypes, factors[1:].ctypes,
        right.ctypes, sizes.ctypes,
    )  # fmt: skip


@kernel
def factorise(product, penalty, factor):  # type: ignore[no-untyped-def]
    """Fill `factor` [n, n] with the Cholesky factor of the matrix from `gram` + diag(penalty); return whether
    there is one."""
    upper = np.array([85], np.uint8)
    sizes = np.array([len(penalty), 0], np.intc)
    assign_rows(factor, product)
    for n in range(len(penalty)):
        factor[n, n] += penalty[n]
    _dpotrf(upper.ctypes, sizes.ctypes, factor.ctypes, sizes.ctypes, sizes[1:].ctypes)
    return sizes[1] == 0


@kernel
def solve(factor, right):  # type: ignore[no-untyped-def]
    """Solve in place for `right` [m, n], with the factors from `factorise`."""
    upper = np.array([85], np.uint8)
    sizes = np.array([len(factor), len(right), 0], np.intc)
    _dpotrs(
        upper.ctypes, sizes.ctypes, sizes[1:].ctypes, factor.ctypes, sizes.ctypes, right.ctypes, sizes.ctypes,
        sizes[2:].ctypes,
    )  # fmt: skip


@kernel
def solve_by_samples(rows, penalty, values, memory, factor, right):  # type: ignore[no-untyped-def]
    """Fill `right` [m, n] with the solution that `gram`, `factorise`, `sums` and `solve` give for `rows` [n,
    samples] and `values` [m, samples], with less work if there are fewer samples than rows. Return whether there
    is a solution.

    x = P^-1 R (R^T P^-1 R + 1)^-1 y uses a matrix with the size of the samples (Golub and Van Loan, Matrix
    Computations, 2.1.4: the Sherman-Morrison-Woodbury formula). The Cholesky factor of this matrix is left in
    `factor` [samples, samples], and its inverse times y in `values`. `memory` has room for 2 n^2.
    """
    count, samples = rows.shape
    weighted_rows = memory[: samples * count].reshape(samples, count)
    for k in range(count):
        weight = 1.0 / np.sqrt(penalty[k])
        for sample in range(samples):
            weighted_rows[sample, k] = weight * rows[k, sample]
    product = memory[count * count : count * count + samples * samples].reshape(samples, samples)
    gram(weighted_rows, product)
    if not factorise(product, np.ones(samples), factor):
        return False
    solve(factor, values)
    sums(rows, values, right)
    for k in range(count):
        for number in range(len(right)):
            right[number, k] /= penalty[k]
    return True


@kernel
def left_out(rows, values, coefficients, factor, step, off):  # type: ignore[no-untyped-def]
    """Fill `off` [m, ...] with the error of the fit to all other samples, for each `step`-th sample.

    `rows` [n, samples], `coefficients` [m, n] and `factor` belong to a solution. If there are fewer samples than
    rows, `values` [m, samples] are the values that `solve_by_samples` has left there; otherwise they are the
    samples. The amount is the residual of the fit to all samples, divided by 1 - h, where h is the diagonal of the
    matrix from samples to fitted values (Golub, Heath, Wahba, Technometrics 21, 1979). In the form with a matrix
    of the size of the samples, both the residual and 1 - h contain the diagonal of its inverse as a factor, which
    cancels.
    """
    (count, samples), size = rows.shape, len(factor)
    columns = np.zeros((off.shape[1], size))
    for place in range(len(columns)):
        if samples < count:
            columns[place, place * step] = 1.0
        else:
            for k in range(count):
                columns[place, k] = rows[k, place * step]
    _half_solve(factor, columns)
    for place in range(len(columns)):
        square = 0.0
        for k in range(size):
            square += columns[place, k] ** 2
        for channel in range(len(values)):
            rest = values[channel, place * step]
            if samples < count:
                off[channel, place] = rest / square
            else:
                for k in range(count):
                    rest -= coefficients[channel, k] * rows[k, place * step]
                off[channel, place] = rest / max(1.0 - square, 1e-9)


@kernel
def _half_solve(factor, right):  # type: ignore[no-untyped-def]
    """Replace each row of `right` [m, n] by L^-1 times the row, where L L^T is the factorised matrix."""
    letters = np.array([76, 85, 84, 78], np.uint8)  # from the left, upper, transposed, not of diagonal 1
    sizes = np.array([len(factor), len(right)], np.intc)
    unity = np.array([1.0])
    _dtrsm(
        letters.ctypes, letters[1:].ctypes, letters[2:].ctypes, letters[3:].ctypes, sizes.ctypes, sizes[1:].ctypes,
        unity.ctypes, factor.ctypes, sizes.ctypes, right.ctypes, sizes.ctypes,
    )  # fmt: skip
