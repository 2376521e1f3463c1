"""Validity by drift: whether a record's figures have changed by more than their uncertainty since it was made.

There are two tests. A `drift` record says how far the LEDs' powers are from their calibration, at equal
temperature. An earlier record of the same kind says how fast a figure changes. If the change between both records
is significant (twice the standard uncertainty of the difference), the change at this rate since the later record
must not exceed its uncertainty.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from datetime import datetime

import numpy as np

from coupole.calibration.in_force import InForce
from coupole.calibration.light.drift_records import CHANNEL
from coupole.calibration.record import Record
from coupole.storage.durable import sha256

_SIGNIFICANT = 2.0


def expired_by_drift(items: Sequence[InForce], earlier: Sequence[InForce], now: datetime) -> tuple[str, ...]:
    """Return one line for each record whose drift exceeds its standard uncertainty."""
    lines = [*_by_drift_records(items)]
    for item in items:
        for before in earlier:
            if before.record.kind == item.record.kind and before.record.created < item.record.created:
                lines += _by_rate(item, before.record, now)
    return tuple(lines)


def _by_drift_records(items: Sequence[InForce]) -> Iterator[str]:
    for item in items:
        if item.record.kind != "led-power":
            continue
        digest = sha256(item.path)
        for candidate in items:
            if candidate.record.kind == "drift" and digest in {line.sha256 for line in candidate.record.inputs}:
                yield from _by_drift_record(item, candidate.record)


def _by_drift_record(item: InForce, drift: Record) -> Iterator[str]:
    hours = drift.value("hours")
    rate = np.array([1.0, hours, 0.0])  # level, rate_per_h, per_k: at the end of the run, at equal temperature
    names = [parameter.name for parameter in drift.parameters]
    at = [names.index(name) for name in ("level", "rate_per_h", "per_k")]
    values = np.array([drift.parameters[n].value or 0.0 for n in at])
    change = float(np.exp(rate @ values) - 1.0)
    u = _relative_u(item.record)
    if abs(change) > u:
        yield (
            f"{item.path}: expired by drift: the LEDs' power has changed by {change:+.2%} since its calibration "
            f"({drift.name}), more than its u of {u:.2%}. Calibrate the LEDs' power anew; till then use it only "
            "with a drift record of the same run"
        )


def _relative_u(record: Record) -> float:
    """Return the relative standard uncertainty of the mean power in the channel in which drift is measured."""
    mean = next(parameter for parameter in record.parameters if parameter.name == f"mean_power.{CHANNEL}")
    return mean.u / max(abs(mean.value or 0.0), 1e-300)


def _by_rate(item: InForce, before: Record, now: datetime) -> Iterator[str]:
    """Yield the figure whose drift exceeds its uncertainty most, if there is one."""
    record = item.record
    age_s = (now - record.created).total_seconds()
    between_s = (record.created - before.created).total_seconds()
    earlier_figures = {p.name: p for p in before.parameters if p.value is not None}
    worst: tuple[float, str] = (1.0, "")
    for parameter in record.parameters:
        old = earlier_figures.get(parameter.name)
        if old is None or old.value is None or parameter.value is None or parameter.u <= 0:
            continue
        change = parameter.value - old.value
        if abs(change) <= _SIGNIFICANT * np.hypot(parameter.u, old.u):
            continue
        drifted_by = change / between_s * age_s
        words = (
            f"{item.path}: expired by drift: {parameter.name} changed by {change:.3g} since {before.name}; at "
            f"that rate it is {drifted_by:+.3g} off by now, more than its u of {parameter.u:.2g}. Calibrate anew"
        )
        worst = max(worst, (abs(drifted_by) / parameter.u, words))
    if worst[1]:
        yield worst[1]
