"""The runs of candidates against their definition."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from loopclosure.matching.consistency import Consistency, Followed


def counted(said):
    return sum(value > 0 for value in said)


def by_definition(frames, candidate, *, both):
    """The chain of candidates, one a frame, that ends here, goes one way by <= 3 and has most frames that count."""

    @cache
    def chain(frame, candidate, sign):
        """What was said for each, newest first; of two equally long chains that of the better candidate."""
        match, value = frames[frame][candidate]
        before = [
            chain(frame - 1, other, sign)
            for other, (one, _) in enumerate(frames[frame - 1] if frame else [])
            if 0 <= sign * (match - one) <= 3
        ]
        return (value, *max(before, key=counted, default=()))

    said = max((chain(len(frames) - 1, candidate, sign) for sign in ((1, -1) if both else (1,))), key=counted)
    return Followed(counted(said), sum(0.05 * 0.95**age * value for age, value in enumerate(said)))


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("both", [False, True])
def test_equals_the_definition(both, count):
    rng = np.random.default_rng(0)
    consistency, seen, place, longest = Consistency(both_directions=both), [], 50, 0
    for _ in range(300):
        place += int(rng.integers(-4, 5)) if rng.random() < 0.2 else int(rng.choice([0, 1, 2]))
        matches = [] if rng.random() < 0.05 else [place, *(place + rng.integers(-9, 10, count - 1)).tolist()]
        values = rng.normal(2, 3, len(matches)).tolist()
        seen.append(list(zip(matches, values, strict=True)))
        for candidate, found in enumerate(consistency.push(matches, values)):
            wanted = by_definition(seen, candidate, both=both)
            assert found.run == wanted.run
            assert found.lasting == pytest.approx(wanted.lasting, abs=1e-9)
            longest = max(longest, wanted.run)
    assert longest > 12


def test_what_lasts_comes_near_to_what_is_said_of_every_frame():
    consistency = Consistency()
    lasting = [consistency.push([place], [4.0])[0].lasting for place in range(100)]
    assert lasting == sorted(lasting)
    assert lasting[0] == pytest.approx(0.2)
    assert 3.9 < lasting[-1] < 4
    assert consistency.push([500], [4.0])[0] == Followed(1, pytest.approx(0.2))


def test_state_comes_back():
    one = Consistency(both_directions=True)
    for match in (30, 29, 28):
        one.push([match, 70], [3.0, 1.0])
    two = Consistency(both_directions=True).restore(one.to_arrays())
    found = two.push([27, 71], [2.0, 2.0])
    assert found == one.push([27, 71], [2.0, 2.0])
    assert [behind.run for behind in found] == [4, 4]
    assert found[0].lasting > found[1].lasting > 0
