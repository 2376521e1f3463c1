"""Sentinels in a burst: where they stand, what they are called, and what they are not."""

from __future__ import annotations

import pytest

from coupole.plan.bursts import with_sentinels
from coupole.plan.shot_id import Led, Sentinel, ShotLabel

LIT = [Led(number) for number in range(100)]
SENTINELS = (10, 40, 70)


def test_sentinels_stand_at_the_begin_at_the_end_and_in_between_in_turn() -> None:
    order = with_sentinels(LIT, SENTINELS, 16)
    sentinels = [light for light in order if isinstance(light, Sentinel)]
    assert [light for light in order if isinstance(light, Led)] == LIT
    assert [light.number for light in sentinels] == list(range(len(sentinels)))
    assert [light.led for light in sentinels] == [*SENTINELS, 10, 40, 70, 10, 40, *SENTINELS]
    assert order[:3] == sentinels[:3]
    assert order[-3:] == sentinels[-3:]


@pytest.mark.parametrize("every", [3, 5, 16, 33])
def test_a_sentinel_rests_before_and_after_its_own_shot(every: int) -> None:
    order = with_sentinels(LIT, SENTINELS, every)
    for place, light in enumerate(order):
        if isinstance(light, Sentinel):
            near = order[max(0, place - 2) : place] + order[place + 1 : place + 3]
            assert light.led not in [other.id if isinstance(other, Led) else other.led for other in near]


def test_without_sentinels_a_burst_is_as_it_was() -> None:
    assert with_sentinels(LIT, (), 16) == LIT


def test_a_sentinels_label_is_read_back_and_is_neither_a_shot_nor_dark() -> None:
    label = ShotLabel(Sentinel(417, 3), 1, 2)
    assert str(label) == "led0417-watch3/e1/r2"
    assert ShotLabel.parse(str(label)) == label
    assert not label.is_shot
    assert not label.is_dark
