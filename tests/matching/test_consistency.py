"""The run of the best candidate against its definition."""

from __future__ import annotations

import numpy as np
import pytest

from loopclosure.matching.consistency import Consistency


def by_definition(matches, *, both):
    """Longest stretch that ends at the last match and whose steps all go one way by at most three."""
    best = 0
    for sign in (1, -1) if both else (1,):
        run = 0
        for i in range(len(matches) - 1, -1, -1):
            if matches[i] is None:
                break
            run += 1
            if i == 0 or matches[i - 1] is None or not 0 <= sign * (matches[i] - matches[i - 1]) <= 3:
                break
        best = max(best, run)
    return best


@pytest.mark.parametrize("both", [False, True])
def test_equals_the_definition(both):
    rng = np.random.default_rng(0)
    consistency, seen, place = Consistency(both_directions=both), [], 50
    for _ in range(500):
        place += int(rng.integers(-4, 5)) if rng.random() < 0.3 else int(rng.choice([-1, 1, 2]))
        seen.append(None if rng.random() < 0.05 else place)
        assert consistency.push(seen[-1]) == by_definition(seen, both=both)


def test_state_comes_back():
    one = Consistency(both_directions=True)
    for match in (30, 29, 28):
        one.push(match)
    two = Consistency(both_directions=True).restore(one.to_arrays())
    assert two.push(27) == one.push(27) == 4
