"""FAB-MAP: how likely the words of a frame are at each place, and not at a new one."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from loopclosure.aggregation.chow_liu import ChowLiuTree
from loopclosure.aggregation.words import EMPTY_BAG, BagOfWords
from loopclosure.config import Config
from loopclosure.errors import FitError, ModelError
from loopclosure.matching.fabmap import FabMap
from loopclosure.matching.inverted_index import InvertedIndex
from loopclosure.matching.standard import StandardScores
from loopclosure.methods.bag_of_words import BagOfWordsMethod
from loopclosure.methods.base import Method
from loopclosure.store import part


class FabMapMethod(Method):
    """Score places by log-odds against all other places and a new one (Cummins & Newman 2008, 2011).

    The map gives log-odds: 0 is a probability of one half. Over a sequence they are counted in standard deviations of
    the log-odds of a frame, see `StandardScores`: with few candidates, or with samples that resemble no place of the
    drive, the best candidate is far more likely than all the rest, right or wrong.

    Vocabulary, tree and the samples of a new place should come from other images than those of the drive
    (``loopclosure fit``). Without a model they are learned from the drive, and then the places of the map stand for
    new ones too.

    Deviations from the source: standard deviations instead of probabilities decide; those of `FabMap`, `ChowLiuTree`
    and `VocabularyTree`.

    Parameters
    ----------
    config : Config
        Its sections `words`, `learning` and `sequence` are used.
    """

    fitted = False
    threshold = 2.2
    sums = StandardScores

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._words = BagOfWordsMethod(config)
        self._tree = ChowLiuTree().fit(np.zeros((1, 1), bool))  # of nothing: a map can be made before `fit`
        self._samples = InvertedIndex([EMPTY_BAG])

    def features(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return local descriptors, see `LocalFeatures`."""
        return self._words.features(images)

    def fit(self, features: Sequence[np.ndarray]) -> None:
        """Learn words, which of them come together, and what places look like."""
        self._words.fit(features)
        bags = [self._words.describe([one]) for one in features]
        learned = FabMap.learn(bags, len(self._words.vocabulary), seed=self.config.learning.seed)
        self._tree, self._samples = learned.tree, learned.samples
        self.fitted = True

    def describe(self, features: Sequence[np.ndarray]) -> BagOfWords:
        """Return the bag of words of the newest frame."""
        if not self.fitted:
            raise FitError("the method has learned no words yet; call fit first")
        return self._words.describe(features)

    def blank(self) -> BagOfWords:
        """Return the bag without words."""
        return EMPTY_BAG

    def new_map(self, *, exclude_recent: int) -> FabMap:
        """Return a map without places."""
        return FabMap(self._tree, self._samples, exclude_recent=exclude_recent)

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return vocabulary, tree and samples."""
        parts = {
            "words": self._words.to_arrays(),
            "tree": self._tree.to_arrays(),
            "samples": self._samples.to_arrays(),
        }
        return {f"{name}.{key}": array for name, arrays in parts.items() for key, array in arrays.items()}

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `to_arrays` gave.

        Raises
        ------
        ModelError
            If the parts are damaged or do not belong together.
        """
        self._words.restore(part(arrays, "words"))
        self._tree = ChowLiuTree.from_arrays(part(arrays, "tree"))
        self._samples = InvertedIndex().restore(part(arrays, "samples"))
        n_words, n_nodes = len(self._words.vocabulary), len(self._tree.parent_)
        if n_words != n_nodes:
            raise ModelError(f"found a tree over {n_nodes} words, the vocabulary has {n_words}: the model is damaged")
        self.new_map(exclude_recent=0)  # refuses samples with words that the tree does not have
        self.fitted = True
