"""Acceptance limits of a calibration, and how an operator sets one.

A calibration lists its limits once, as `Allowed`. Its command uses the list for `--limit NAME=VALUE` and for its
help. Its workflow uses the list for the record (`against_limits`). The record keeps the default beside the
operator's limit.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from coupole.errors import InputError

if TYPE_CHECKING:
    from coupole.calibration.record import Limit


@dataclass(frozen=True)
class Allowed:
    """One limit: the largest value that a figure may have."""

    name: str
    """Name of the figure for `--limit`, with its unit."""
    description: str
    usual: float
    unit: str = ""


def words_of(limits: Sequence[Allowed]) -> str:
    """The limits for a command's help."""
    return "; ".join(f"{limit.name}={limit.usual:g} ({limit.description})" for limit in limits)


def parse_limits(words: Sequence[str], limits: Sequence[Allowed]) -> dict[str, float]:
    """Read limits as operators write them: `NAME=VALUE`. Raises InputError for an unknown limit, for one that is
    given twice, and for a value that is not a positive number."""
    limit_by_name: dict[str, float] = {}
    names = {limit.name for limit in limits}
    for word in words:
        name, _, text = word.partition("=")
        if name not in names:
            raise InputError(
                f"--limit {word}: expected one of {', '.join(limit.name for limit in limits)}, then =VALUE"
            )
        if name in limit_by_name:
            raise InputError(f"--limit {word}: {name} is given twice")
        try:
            limit_by_name[name] = float(text)
        except ValueError:
            limit_by_name[name] = math.nan
        if not 0.0 < limit_by_name[name] < math.inf:
            raise InputError(f"--limit {word}: expected a number greater than 0 after `{name}=`")
    return limit_by_name


def against_limits(
    limits: Sequence[Allowed], operator_limits: Mapping[str, float], figures: Mapping[str, float]
) -> tuple[Limit, ...]:
    """Compare figures with their limits, in the form that the record keeps. `operator_limits` are the limits that
    the operator set; `figures` has a figure for each limit."""
    from coupole.calibration.record import Limit

    return tuple(
        Limit(
            what=limit.description,
            found=figures[limit.name],
            limit=operator_limits.get(limit.name, limit.usual),
            unit=limit.unit,
            name=limit.name,
            usual=limit.usual if limit.name in operator_limits else None,
        )
        for limit in limits
    )
