"""Nothing that is read is trusted: mutated files end in success or in an error that names them."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from datetime import UTC, datetime

import pytest
from fuzz.harness import HOSTILE_SEED, Fuzzer
from fuzz.mutation import HOSTILE
from fuzz.targets import TARGETS, Target

SEED = datetime.now(UTC).date().isoformat()
CASES, CASES_IN_FULL = 10, 10_000 // len(TARGETS) + 1


@pytest.fixture(scope="module")
def fuzzer() -> Iterator[Fuzzer]:
    fuzzer = Fuzzer()
    yield fuzzer
    fuzzer.close()


@pytest.mark.timeout(7200)
@pytest.mark.parametrize("target", TARGETS, ids=lambda target: target.name)
def test_a_mutated_file_is_read_or_refused_by_name(
    fuzzer: Fuzzer, target: Target, scale: Callable[[int, int], int]
) -> None:
    found = fuzzer.violations(target, SEED, range(scale(CASES, CASES_IN_FULL)))
    assert not found, "\n".join(map(str, found))


NAMES = {"plan", "rig", "arm", "record", "index", "paint", "lights", "run-json", "journal", "ledger", "arm-faults"}
TEXTS = [target for target in TARGETS if target.name in NAMES | {"result", "pictures", "queue"}]


@pytest.mark.timeout(7200)
@pytest.mark.parametrize("target", TEXTS, ids=lambda target: target.name)
def test_a_hostile_value_is_read_or_refused_by_name(
    fuzzer: Fuzzer, target: Target, scale: Callable[[int, int], int]
) -> None:
    today = datetime.now(UTC).toordinal()
    cases = scale(2, 20 * len(HOSTILE))
    found = fuzzer.violations(target, f"{HOSTILE_SEED}-{SEED}", range(today, today + cases))
    assert not found, "\n".join(map(str, found))
