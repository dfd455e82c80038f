"""How likely a word is to be seen at a place, given what was seen there before: the factors of FAB-MAP."""

from __future__ import annotations

import numpy as np

from loopclosure.aggregation.chow_liu import ChowLiuTree
from loopclosure.errors import ConfigError


class WordLikelihoods:
    """Logarithms of ``p(z_q | z_parent, place)``, the factors of the likelihood.

    Parameters
    ----------
    tree : ChowLiuTree
        Fitted.
    p_seen_if_there, p_seen_if_absent : float
        The detector: ``p(z = 1 | e = 1)`` and ``p(z = 1 | e = 0)``, where e says that the thing behind the word
        is there and z that the word is seen.

    Attributes
    ----------
    shown, hidden, average : ndarray of float64, shape (2, 2, W)
        The factor at ``[z_q, z_parent, q]`` for a place that was seen to show the word q, one that was not, and
        the average place.

    References
    ----------
    Cummins & Newman 2008, Sec. 4.3 and 5.2.
    """

    def __init__(self, tree: ChowLiuTree, *, p_seen_if_there: float = 0.39, p_seen_if_absent: float = 0.0) -> None:
        if not 0 <= p_seen_if_absent < p_seen_if_there < 1:
            raise ConfigError(
                f"found p(z|there) = {p_seen_if_there} and p(z|absent) = {p_seen_if_absent}, "
                "wanted 0 <= p(z|absent) < p(z|there) < 1"
            )
        prior = tree.marginal_
        if_there = _given_existence(tree, p_seen_if_there)
        if_absent = _given_existence(tree, p_seen_if_absent)

        def factor(p_there: np.ndarray) -> np.ndarray:
            return np.log(p_there * if_there + (1 - p_there) * if_absent)

        self.shown = factor(_existence(prior, p_seen_if_there, p_seen_if_absent))
        self.hidden = factor(_existence(prior, 1 - p_seen_if_there, 1 - p_seen_if_absent))
        self.average = factor(prior)


def _existence(prior: np.ndarray, if_there: float, if_absent: float) -> np.ndarray:
    """Return p(e = 1 | what was seen at the place) by Bayes' rule."""
    return if_there * prior / (if_there * prior + if_absent * (1 - prior))


def _given_existence(tree: ChowLiuTree, p_seen: float) -> np.ndarray:
    """Return p(z_q | e_q, z_parent) as (z_q, z_parent, q), where p(z_q = 1 | e_q) is `p_seen`."""
    seen = np.stack([tree.given_no_parent_, tree.given_parent_])
    weight = np.stack([(1 - p_seen) * (1 - seen) * tree.marginal_, p_seen * seen * (1 - tree.marginal_)])
    return weight / weight.sum(0)
