"""FAB-MAP: how likely is it that a bag of words shows a place of the map, and not a new one?"""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from loopclosure.aggregation.chow_liu import ChowLiuTree
from loopclosure.aggregation.words import BagOfWords, occurrence
from loopclosure.errors import ConfigError, ModelError
from loopclosure.matching.inverted_index import InvertedIndex
from loopclosure.matching.word_likelihoods import WordLikelihoods

NewPlace = Literal["sampled", "mean_field"]


class FabMap:
    """A map of places that tells, for a bag of words, the log-odds of each place.

    The likelihood of an observation z at a place is the product over **all** words q of the vocabulary of
    ``p(z_q | z_parent(q), place)``. Here it is written as the likelihood at a place without any word (one number for
    the whole map) times a ratio for each word that the place shows. Of these ratios only those differ from their value
    for an empty observation whose word or whose parent is seen, and these the inverted index finds: a frame costs its
    own words. FAB-MAP 2.0 takes the same road. All is kept as logarithms, so that nothing underflows.

    FAB-MAP 1 and 2 give the same likelihoods up to a factor that is the same for all places; they differ in the new
    place: the average place (``mean_field``) or the mean over places sampled from the training images (``sampled``).

    Deviations from the sources: RootSIFT words instead of SURF-128; every frame is a place of its own, as in the
    public re-implementations, so nothing is updated when a place is seen again; no motion model, sequences of frames
    do that work in a later stage; existence has the prior P(z = 1), as in openFABMAP; a frame or a place without any
    feature says nothing, so that it gets the prior instead of the likelihood of darkness; similarities are log-odds
    before smoothing, because smoothing makes them depend on the number of candidates (`posterior` smooths).

    Parameters
    ----------
    tree : ChowLiuTree
        Fitted on images of other places.
    samples : InvertedIndex, optional
        Training images that stand for a new place when it is ``sampled``.
    exclude_recent : int
        In one stream, frames nearer than this are no candidates: the last frames look alike and would take the
        probability from all others. 0 for another traverse.
    new_place : {"sampled", "mean_field"}
        How the likelihood of a new place is found.
    p_seen_if_there, p_seen_if_absent : float
        Detector model, see `WordLikelihoods`.
    p_new : float
        Prior probability of a new place; the known ones share the rest evenly.

    References
    ----------
    Cummins & Newman, "FAB-MAP: Probabilistic localization and mapping in the space of appearance", IJRR 27(6), 2008;
    Cummins & Newman, "Appearance-only SLAM at large scale with FAB-MAP 2.0", IJRR 30(9), 2011.
    """

    def __init__(
        self,
        tree: ChowLiuTree,
        samples: InvertedIndex | None = None,
        *,
        exclude_recent: int = 0,
        new_place: NewPlace = "sampled",
        p_seen_if_there: float = 0.39,
        p_seen_if_absent: float = 0.0,
        p_new: float = 0.9,
    ) -> None:
        if not 0 < p_new < 1:
            raise ConfigError(f"p_new = {p_new}: wanted a probability between 0 and 1")
        if new_place == "sampled" and not samples:
            raise ConfigError("a sampled new place needs bags of training images; give samples or take 'mean_field'")
        self.tree, self.new_place, self.p_new = tree, new_place, p_new
        factors = WordLikelihoods(tree, p_seen_if_there=p_seen_if_there, p_seen_if_absent=p_seen_if_absent)
        self._hidden = factors.hidden
        self._shown_ratio = factors.shown - factors.hidden
        self._average_ratio = factors.average - factors.hidden
        self._children = np.argsort(tree.parent_, kind="stable")
        self._first_child = np.searchsorted(tree.parent_[self._children], np.arange(len(tree.parent_) + 1)).tolist()
        self._samples = _Places(samples or InvertedIndex(), self._shown_ratio[0, 0])
        self._places = _Places(InvertedIndex(), self._shown_ratio[0, 0])
        self._excluded = max(exclude_recent - 1, 0)  # the new frame itself is not in the map yet

    @classmethod
    def learn(
        cls, bags: Sequence[BagOfWords], n_words: int, *, max_samples: int = 3000, seed: int = 0, **options: Any
    ) -> FabMap:
        """Learn tree and samples from bags of training images; `options` go to the constructor.

        Parameters
        ----------
        bags : sequence of BagOfWords
            Of images that show other places than the map will, and no place twice.
        n_words : int
            Size of the vocabulary.
        max_samples : int
            At most so many bags stand for a new place; a random choice where there are more.
        seed : int
            Of that choice.
        """
        chosen = np.arange(len(bags))
        if len(bags) > max_samples:
            chosen = np.sort(np.random.default_rng(seed).choice(len(bags), max_samples, replace=False))
        tree = ChowLiuTree().fit(occurrence(bags, n_words))
        return cls(tree, InvertedIndex(bags[i] for i in chosen.tolist()), **options)

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self._places.index)

    def add(self, bag: BagOfWords) -> None:
        """Append a place."""
        self._places.add(bag)

    @property
    def samples(self) -> InvertedIndex:
        """Training images that stand for a new place."""
        return self._samples.index

    @property
    def nbytes(self) -> int:
        """Bytes that the stored places take."""
        return self._places.index.nbytes

    def similarities(self, bag: BagOfWords) -> np.ndarray:
        """Return the log-odds of each candidate against all other candidates and the new place.

        Parameters
        ----------
        bag : BagOfWords
            The observation.

        Returns
        -------
        ndarray of float32, shape (n,)
            Frames that are no candidates get what an observation that says nothing gives.
        """
        known, new = self.log_likelihoods(bag)
        candidates = max(len(known) - self._excluded, 0)
        prior = (1 - self.p_new) / max(candidates, 1)
        row = np.full(len(known), np.log(prior / (1 - prior)), np.float32)
        row[:candidates] = log_odds(known[:candidates], new, p_new=self.p_new)
        return row

    def log_likelihoods(self, bag: BagOfWords) -> tuple[np.ndarray, float]:
        """Return the log-likelihoods of `bag` at each place and at a new place.

        They are relative to a place where nothing was seen (FAB-MAP 2.0); add `log_likelihood_unseen` for those of
        FAB-MAP 1.

        Returns
        -------
        known : ndarray of float64, shape (n,)
        new : float
        """
        if not len(bag.words):
            return np.zeros(len(self)), 0.0
        touched, state = self._touched(bag.words)
        change = _change(self._shown_ratio, touched, state)
        if self.new_place == "mean_field":
            new = self._average_ratio[0, 0].sum() + _change(self._average_ratio, touched, state).sum()
        else:
            sums = self._samples.sums(touched, change)
            new = np.logaddexp.reduce(sums) - np.log(len(sums))
        known = self._places.sums(touched, change)
        known[self._places.blank] = new
        return known, float(new)

    def log_likelihood_unseen(self, bag: BagOfWords) -> float:
        """Return the log-likelihood of `bag` at a place where nothing was seen."""
        return float(self._hidden[0, 0].sum() + _change(self._hidden, *self._touched(bag.words)).sum())

    def _touched(self, words: np.ndarray) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray]]:
        """Return the words that are seen or whose parent is, and for each whether it and whether its parent is seen."""
        first = self._first_child
        children = [self._children[first[word] : first[word + 1]] for word in words.tolist()]
        touched = np.unique(np.concatenate([words, *children]))
        parents = self.tree.parent_[touched]
        return touched, (np.isin(touched, words).astype(np.intp), np.isin(parents, words).astype(np.intp))

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the places, for `loopclosure.store`; tree and samples are learned, not mapped."""
        return self._places.index.to_arrays()

    def restore(self, arrays: Mapping[str, np.ndarray]) -> FabMap:
        """Take over the places that `to_arrays` gave; returns the map.

        Raises
        ------
        ModelError
            If they are damaged, or show words that the vocabulary does not have.
        """
        self._places = _Places(InvertedIndex().restore(arrays), self._shown_ratio[0, 0])
        return self


class _Places:
    """Places with the sum of their ratios for an observation without words."""

    def __init__(self, index: InvertedIndex, ratio: np.ndarray) -> None:
        self.index = index
        self._ratio = ratio
        held = index.to_arrays()
        if len(held["words"]) and not 0 <= held["words"][0] <= held["words"][-1] < len(ratio):
            raise ModelError(f"the saved places show words outside the {len(ratio)} of the vocabulary: damaged")
        sums = np.bincount(held["places"], ratio[held["words"]], minlength=len(index))
        self._sums = array("d", sums.tobytes())
        self.blank = np.flatnonzero(np.bincount(held["places"], minlength=len(index)) == 0).tolist()

    def add(self, bag: BagOfWords) -> None:
        if not len(bag.words):
            self.blank.append(len(self.index))
        self._sums.append(self._ratio[bag.words].sum())
        self.index.add(bag)

    def sums(self, touched: np.ndarray, change: np.ndarray) -> np.ndarray:
        """Return the sum of the ratios at each place, shape (n,), where `touched` words change theirs."""
        counts, places, _ = self.index.postings(touched)
        return np.bincount(places, np.repeat(change, counts), minlength=len(self.index)) + np.array(self._sums)


def _change(table: np.ndarray, touched: np.ndarray, state: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
    """Return by how much the entries of `touched` differ from those of an observation without words."""
    return table[state[0], state[1], touched] - table[0, 0, touched]


def log_odds(known: np.ndarray, new: float, *, p_new: float = 0.9) -> np.ndarray:
    """Return the log-odds of each place against all others and the new place.

    Parameters
    ----------
    known : ndarray of float64, shape (n,)
        Log-likelihoods of the places.
    new : float
        Log-likelihood of a new place.
    p_new : float
        Its prior probability.

    Returns
    -------
    ndarray of float64, shape (n,)
        Larger = more likely; 0 is a probability of one half.

    Examples
    --------
    >>> log_odds(np.log([0.4, 0.1]), np.log(0.5), p_new=1 / 3).round(3)
    array([-0.405, -2.197])
    """
    joint = _log_joint(known, new, p_new)
    odds = np.empty(len(known))
    total = np.logaddexp.reduce(joint)
    best = int(joint.argmax())
    # 1 - p loses all digits where p is almost 1, so that the most likely one is compared with the sum of the others.
    others = np.logaddexp.reduce(np.delete(joint, best))
    log_p = joint[:-1] - total
    with np.errstate(divide="ignore"):
        odds[:] = log_p - np.log1p(-np.exp(log_p))
    if best < len(known):
        odds[best] = joint[best] - others
    return odds


def posterior(known: np.ndarray, new: float, *, p_new: float = 0.9, smoothing: float = 0.99) -> np.ndarray:
    """Return the probability of each place and, last, of a new one, smoothed: ``0.99 p + 0.01 / (n + 1)``.

    Parameters
    ----------
    known, new, p_new
        As for `log_odds`.
    smoothing : float
        Weight of the probabilities against the uniform distribution.

    Returns
    -------
    ndarray of float64, shape (n + 1,)
        Of sum 1.

    Examples
    --------
    >>> posterior(np.log([0.4, 0.1]), np.log(0.5), p_new=1 / 3, smoothing=1).round(3)
    array([0.4, 0.1, 0.5])
    """
    joint = _log_joint(known, new, p_new)
    return smoothing * np.exp(joint - np.logaddexp.reduce(joint)) + (1 - smoothing) / len(joint)


def _log_joint(known: np.ndarray, new: float, p_new: float) -> np.ndarray:
    prior = (1 - p_new) / max(len(known), 1)
    return np.append(known + np.log(prior), new + np.log(p_new))
