"""Bags of visual words: over a vocabulary that was trained before, or over one that grows on the way."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from loopclosure.aggregation.words import EMPTY_BAG, BagOfWords, VocabularyTree
from loopclosure.config import Config
from loopclosure.errors import FitError, ModelError
from loopclosure.features.keypoints import DESCRIPTOR_SIZES, KeypointExtractor
from loopclosure.matching.inverted_index import BagOfWordsMap, IncrementalMap
from loopclosure.matching.standard import StandardScores
from loopclosure.methods.base import Method

_REFIT_SAMPLES = 60_000  # local features; from these k-means takes a second


class LocalFeatures:
    """Images to arrays of local descriptors, all of one shape.

    Parameters
    ----------
    config : Config
        Its section `words` is used.
    """

    def __init__(self, config: Config) -> None:
        words = config.words
        self._extract = KeypointExtractor(words.keypoints, max_features=words.max_features, side=words.side)
        self.shape = words.max_features, DESCRIPTOR_SIZES[words.keypoints]
        self.dtype = np.dtype(np.uint8 if words.keypoints == "orb" else np.float16)

    def __call__(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return the descriptors of each image, strongest first.

        Parameters
        ----------
        images : sequence of ndarray of uint8, shape (h, w, 3)

        Returns
        -------
        list of ndarray of float16 (RootSIFT) or uint8 (ORB), shape (max_features, d)
            Rows of zeros where an image has fewer features.
        """
        described = []
        for image in images:
            found = self._extract(image).descriptors
            rows = np.zeros(self.shape, self.dtype)
            rows[: len(found)] = found
            described.append(rows)
        return described


def features_in(rows: np.ndarray) -> np.ndarray:
    """Return the rows that are features: those that are not zero."""
    return rows[rows.any(axis=1)]


class BagOfWordsMethod(Method):
    """Compare images by the L1 score of their tf-idf weighted words (Galvez-Lopez & Tardos 2012).

    The score of a loop is in standard deviations of the scores of a frame, see `StandardScores`.

    The vocabulary should come from other images than those of the drive (``loopclosure fit``). Without a model it is
    learned from the drive, which gives few words and a poor idea of how rare they are.

    Deviations from the source, beside those of `VocabularyTree` and `BagOfWordsMap`: RootSIFT unless
    ``words.keypoints`` says ORB, two levels of 100 branches instead of six of 10, because errors of the descent cost
    more than the larger nodes, and standard deviations instead of division by the score against the previous frame.

    Parameters
    ----------
    config : Config
        Its sections `words`, `learning` and `sequence` are used.
    """

    fitted = False
    threshold = 2.35
    sums = StandardScores

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._local = LocalFeatures(config)
        self.vocabulary = VocabularyTree(config.words.branching, config.words.levels, seed=config.learning.seed)

    def features(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return local descriptors, see `LocalFeatures`."""
        return self._local(images)

    def fit(self, features: Sequence[np.ndarray]) -> None:
        """Learn the words and their rarity; anew from fewer features, because then a drive is waiting."""
        if self.fitted:
            self.vocabulary.max_samples = _REFIT_SAMPLES
        self.vocabulary.fit([features_in(rows) for rows in features])
        self.fitted = True

    def describe(self, features: Sequence[np.ndarray]) -> BagOfWords:
        """Return the bag of words of the newest frame."""
        if not self.fitted:
            raise FitError("the method has learned no words yet; call fit first")
        return self.vocabulary.transform(features_in(features[-1]))

    def blank(self) -> BagOfWords:
        """Return the bag without words."""
        return EMPTY_BAG

    def new_map(self, *, exclude_recent: int) -> BagOfWordsMap:  # noqa: ARG002  (each place is scored alone)
        """Return an empty map for bags of words."""
        return BagOfWordsMap()

    def to_arrays(self) -> dict[str, np.ndarray]:
        """Return the vocabulary."""
        return self.vocabulary.to_arrays()

    def restore(self, arrays: Mapping[str, np.ndarray]) -> None:
        """Take over what `to_arrays` gave.

        Raises
        ------
        ModelError
            If the vocabulary is damaged or of other features than ``words.keypoints`` says.
        """
        words_of_bits = arrays["centres"].dtype == np.uint8
        if words_of_bits != (self._local.dtype == np.uint8) or arrays["centres"].shape[1:] != self._local.shape[1:]:
            raise ModelError(
                f"the model has words of {'orb' if words_of_bits else 'rootsift'} features, wanted "
                f"{self.config.words.keypoints}; set words.keypoints or fit again"
            )
        self.vocabulary.restore(arrays)
        self.fitted = True


class IncrementalBagOfWords(Method):
    """Compare images by words that appear as the drive goes on: nothing is trained (Angeli et al. 2008).

    The score of a loop is in standard deviations of the scores of a frame, see `StandardScores`.

    Deviations from the source: those of `IncrementalWords` and `IncrementalMap`.

    Parameters
    ----------
    config : Config
        Its sections `words` (but for the tree) and `sequence` are used.
    """

    threshold = 2.8
    sums = StandardScores

    def __init__(self, config: Config) -> None:
        super().__init__(config)
        self._local = LocalFeatures(config)

    def features(self, images: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Return local descriptors, see `LocalFeatures`."""
        return self._local(images)

    def describe(self, features: Sequence[np.ndarray]) -> np.ndarray:
        """Return the local descriptors of the newest frame, float32 or packed bits, shape (max_features, d)."""
        return features[-1] if self._local.dtype == np.uint8 else features[-1].astype(np.float32)

    def blank(self) -> np.ndarray:
        """Return no feature at all: zeros."""
        return self.describe([np.zeros(self._local.shape, self._local.dtype)])

    def new_map(self, *, exclude_recent: int) -> IncrementalMap:  # noqa: ARG002  (each place is scored alone)
        """Return a map without words and places."""
        return IncrementalMap()
