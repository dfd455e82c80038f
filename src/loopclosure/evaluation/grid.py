"""The paper's grid: every layer at every compression ratio, from cached feature maps to the best match of every frame.

A cell gives what `LoopDetector` gives with a model fitted on the same images: the same frames to fit on, the same
transform, clusters, centring and sequences, only for all frames at once.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure import store
from loopclosure.aggregation.centring import RunningMean, centre_traverse
from loopclosure.aggregation.netvlad import NetVLAD
from loopclosure.compression import ChannelKL, choose_components
from loopclosure.config import Config
from loopclosure.errors import ConfigError
from loopclosure.evaluation.cache import BLOCK, MapCache, digest
from loopclosure.evaluation.log import NONE, LoopLog
from loopclosure.matching.consistency import Consistency
from loopclosure.matching.sequences import SequenceScores
from loopclosure.methods.kl_netvlad import KLNetVLAD

_THUMBNAIL = 400  # largest side of the score matrix that a cell keeps

Codes = Callable[[np.ndarray], np.ndarray]


@dataclass(frozen=True)
class Cell:
    """What one layer at one ratio came to.

    Attributes
    ----------
    layer : str
        Tap of the network.
    gamma : float or None
        Compression ratio; None is the layer as it is.
    components, channels : int
        Length of a local vector after and before the transform.
    fitted_on : str
        What basis and clusters were learned on.
    match : ndarray of int64, shape (n,)
        Best candidate of each frame, -1 where there is none.
    score : ndarray of float64, shape (n,)
        Its score; NaN where there is none.
    matrix : ndarray of float32, shape (at most 400, at most 400)
        Sequence scores, the largest of each cell; NaN where no pair is a candidate.
    energies : ndarray of float64, shape (channels,)
        Eigenvalues, largest first; empty without the transform.
    """

    layer: str
    gamma: float | None
    components: int
    channels: int
    fitted_on: str
    match: np.ndarray
    score: np.ndarray
    matrix: np.ndarray
    energies: np.ndarray

    def log(self, config: Config) -> LoopLog:
        """Return the log of a detector that decides by these settings."""
        chosen = config.decision.threshold
        accepted = np.nan_to_num(self.score, nan=-np.inf) >= (KLNetVLAD.threshold if chosen is None else chosen)
        consistency = Consistency(both_directions=config.sequence.direction == "both")
        runs = [
            max((one.run for one in consistency.push([] if match == NONE else [match])), default=0)
            for match in self.match.tolist()
        ]
        accepted &= np.array(runs, dtype=int) >= config.decision.consistency
        n = len(self.match)
        return LoopLog(self.match, self.score, accepted, np.full(n, NONE), ("",) * n)


def fill_grid(
    maps: MapCache,
    gammas: Sequence[float | None],
    config: Config,
    folder: Path,
    *,
    progress: Callable[[str, int, int], None] | None = None,
) -> list[Cell]:
    """Return a cell for every layer and ratio, layer by layer; those that were finished before are read.

    Parameters
    ----------
    maps : MapCache
        Filled.
    gammas : sequence of float or None
        Compression ratios; None is the layer as it is.
    config : Config
        Its sections `aggregation`, `learning`, `sequence` and ``compression.whiten`` are used.
    folder : path
        Where finished cells lie.
    progress : callable, optional
        ``progress(stage, done, total)``.
    """
    if config.compression.reading != "channel":
        raise ConfigError(
            f"compression.reading = '{config.compression.reading}', wanted 'channel': the grid is of that reading"
        )
    cells: list[Cell] = []
    for layer in maps.layers:
        places = {gamma: folder / digest(_made_by(maps, layer, gamma, config)) for gamma in gammas}
        missing = [gamma for gamma, place in places.items() if not (place / store.HEADER).is_file()]
        if missing:
            _Layer(maps, layer, missing, config).write({gamma: places[gamma] for gamma in missing})
        cells += [_load(place) for place in places.values()]
        if progress:
            progress("layers and ratios", len(cells), len(maps.layers) * len(gammas))
    return cells


class _Layer:
    """One layer: its transform is fitted once, for the lowest ratio; higher ones keep the first of its components."""

    def __init__(self, maps: MapCache, layer: str, gammas: Sequence[float | None], config: Config) -> None:
        self._maps, self._layer, self._config = maps, layer, config
        chosen = fitting_frames(len(maps), maps.frame_bytes(layer), config)
        self._sample = maps.take(layer, chosen)
        self._fitted_on = f"{len(chosen)} of the {len(maps)} test images"
        ratios = [gamma for gamma in gammas if gamma is not None]
        self._kl = ChannelKL(gamma=min(ratios), whiten=config.compression.whiten).fit(self._sample) if ratios else None

    def write(self, places: dict[float | None, Path]) -> None:
        """Work the cells out one by one; each is saved when it is finished."""
        for gamma, place in places.items():
            k, codes = self._codes(gamma)
            match, score, matrix = self._search(codes)
            store.save_arrays(
                place,
                kind="cell",
                header={
                    "layer": self._layer,
                    "gamma": gamma,
                    "components": k,
                    "channels": int(self._sample.shape[-1]),
                    "fitted_on": self._fitted_on,
                },
                arrays={
                    "match": match,
                    "score": score,
                    "matrix": matrix,
                    "energies": np.zeros(0) if gamma is None or self._kl is None else self._kl.energies_,
                },
            )

    def _codes(self, gamma: float | None) -> tuple[int, Codes]:
        """Return the length of a local vector and what makes codes of maps."""
        kl = self._kl
        if gamma is None or kl is None:
            return int(self._sample.shape[-1]), lambda maps: maps
        k = choose_components(kl.energies_, gamma=gamma)
        return k, lambda maps: np.ascontiguousarray(kl.transform(maps)[..., :k])

    def _search(self, codes: Codes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        netvlad = NetVLAD(self._config.aggregation.clusters, seed=self._config.learning.seed).fit(codes(self._sample))
        size = netvlad.centres_.size
        with tempfile.TemporaryFile() as file:  # descriptors of a long drive are larger than memory
            descriptors = np.memmap(file, np.float32, "w+", shape=(len(self._maps), size))
            mean = self._mean(netvlad, codes)
            row = 0
            for block in self._maps.blocks(self._layer):
                for descriptor in netvlad.transform(codes(block)):
                    descriptors[row] = mean.centre(descriptor)
                    row += 1
            return best_matches(descriptors, self._config)

    def _mean(self, netvlad: NetVLAD, codes: Codes) -> RunningMean:
        """Return what takes the running mean out, if that is asked for; it begins with the mean of the sample."""
        window = self._config.aggregation.centre_window
        if not window:
            return RunningMean(0)
        return RunningMean(window, prior=centre_traverse(netvlad.transform(codes(self._sample)), window=window)[1])


def fitting_frames(frames: int, frame_bytes: int, config: Config) -> list[int]:
    """Return the frames that a detector would be fitted on: evenly spaced, as many as memory and settings allow."""
    learning = config.learning
    most = max(2, min(learning.fit_frames, int(learning.max_kept_mb * 1e6 / frame_bytes)))
    return sorted({round(position) for position in np.linspace(0, frames - 1, min(frames, most))})


def best_matches(descriptors: np.ndarray, config: Config) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Search one stream of descriptors.

    Parameters
    ----------
    descriptors : ndarray of float32, shape (n, d)
        Unit rows; zeros for blank frames.
    config : Config
        Its section `sequence` is used.

    Returns
    -------
    match : ndarray of int64, shape (n,)
    score : ndarray of float64, shape (n,)
    matrix : ndarray of float32, shape (at most 400, at most 400)
        As in `Cell`.
    """
    n, sequence = len(descriptors), config.sequence
    scores = SequenceScores(
        sequence.length, exclude_recent=sequence.exclude_recent, both_directions=sequence.direction == "both"
    )
    matrix = np.full((n, n), np.nan, np.float32)
    for start in range(0, n, BLOCK):
        cosines = descriptors[start : start + BLOCK] @ descriptors[: start + BLOCK].T
        for query, row in enumerate(np.clip((1 + cosines) / 2, 0, 1), start):
            matrix[query, :query] = scores.push(row[:query])
    candidate = ~np.isnan(matrix).all(1)
    match, score = np.full(n, NONE, np.int64), np.full(n, np.nan)
    match[candidate] = np.nanargmax(matrix[candidate], axis=1)
    score[candidate] = matrix[candidate, match[candidate]]
    return match, score, _thumbnail(matrix)


def _thumbnail(matrix: np.ndarray) -> np.ndarray:
    """Return the matrix at a bounded size: the largest score of each cell."""
    starts = np.arange(0, len(matrix), -(-len(matrix) // _THUMBNAIL))
    return np.fmax.reduceat(np.fmax.reduceat(matrix, starts, axis=0), starts, axis=1)


def _made_by(maps: MapCache, layer: str, gamma: float | None, config: Config) -> dict[str, Any]:
    learning = config.learning.model_dump(include={"fit_frames", "max_kept_mb", "seed"})
    return {
        **maps.identity,
        "layer": layer,
        "images": maps.hashes,
        "gamma": gamma,
        "whiten": config.compression.whiten,
        "aggregation": config.aggregation.model_dump(),
        "learning": learning,
        "sequence": config.sequence.model_dump(),
    }


def _load(place: Path) -> Cell:
    header, arrays = store.load_arrays(place, kind="cell")
    facts = {name: header[name] for name in ("layer", "gamma", "components", "channels", "fitted_on")}
    return Cell(**facts, **arrays)  # type: ignore[arg-type]
