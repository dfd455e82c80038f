"""The runs of candidates against their definition."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.matching.consistency import Consistency


def by_definition(frames, match, *, both):
    """Longest chain of candidates, one a frame, that ends at `match` in the last frame and goes one way by <= 3."""

    def chain(frame, match, sign):
        before = frames[frame - 1] if frame else []
        return 1 + max((chain(frame - 1, one, sign) for one in before if 0 <= sign * (match - one) <= 3), default=0)

    return max(chain(len(frames) - 1, match, sign) for sign in ((1, -1) if both else (1,)))


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("both", [False, True])
def test_equals_the_definition(both, count):
    rng = np.random.default_rng(0)
    consistency, seen, place = Consistency(both_directions=both), [], 50
    for _ in range(60 if count > 1 else 300):
        place += int(rng.integers(-4, 5)) if rng.random() < 0.3 else int(rng.choice([-1, 1, 2]))
        others = rng.integers(0, 100, count - 1).tolist()
        seen.append([] if rng.random() < 0.1 else [place, *others])
        recent = seen[-12:]
        runs = consistency.push(seen[-1])
        for match, run in zip(seen[-1], runs, strict=True):
            assert min(run, 12) == min(by_definition(recent, match, both=both), 12)


def test_state_comes_back():
    one = Consistency(both_directions=True)
    for match in (30, 29, 28):
        one.push([match, 70])
    two = Consistency(both_directions=True).restore(one.to_arrays())
    assert two.push([27, 71]) == one.push([27, 71]) == [4, 4]
