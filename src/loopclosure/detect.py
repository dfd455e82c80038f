"""LoopDetector: images in, decisions out. Each stage is a line of `LoopDetector._step`, in the order of the paper."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from loopclosure import store
from loopclosure.config import Config
from loopclosure.errors import FitError, LoopClosureError, ModelError
from loopclosure.images.ahead import read_ahead
from loopclosure.images.decode import check_image
from loopclosure.methods import Method, PlaceMap, build_method
from loopclosure.records import Decision, Reason
from loopclosure.timing import Stopwatch
from loopclosure.traverse import Traverse, describe, describe_traverse
from loopclosure.warmup import WarmUp

_MEAN = "mean_of_fit"  # beside the arrays of a method
Progress = Callable[[int, int], None]


class Frames(Protocol):
    """A traverse: uint8 RGB images (h, w, 3), None for an unreadable one. A list will do; so does `ImageSequence`."""

    def __len__(self) -> int: ...
    def __iter__(self) -> Iterator[np.ndarray | None]: ...
    def __getitem__(self, index: int, /) -> np.ndarray | None: ...


class LoopDetector:
    """Tell, image by image, whether the robot is back at a place that it has seen.

    With no model given the detector learns from the drive itself: the first frames (``learning.warm_up``, never more
    than ``sequence.exclude_recent``, where no loop can be closed anyway) are collected, the method is fitted on them,
    and fitted anew at the frame counts ``learning.refit_at``, each time on past frames only and without a second look
    at an image. Against a reference traverse (`set_reference`) it is fitted on that traverse.

    Parameters
    ----------
    config : Config, optional
        All settings; the embedded default, or what `model` was fitted with.
    model : path, optional
        Folder that `save_model` or ``loopclosure fit`` wrote.
    progress : callable, optional
        ``progress(done, total)`` in bytes, where weights have to be downloaded.

    Attributes
    ----------
    method : Method
        What describes and compares images.
    frames : int
        Frames added so far.
    scores : ndarray of float32, shape (n,)
        Sequence score of the last frame to each frame of the map; NaN where that is no candidate.
    learned_on : list of str
        What the method was fitted on, in order.

    Raises
    ------
    ConfigError, WeightsError, ModelError
        If the settings, the weights or the model cannot be used.

    Examples
    --------
    >>> detector = LoopDetector()                                   # doctest: +SKIP
    >>> for image in images:                                        # doctest: +SKIP
    ...     decision = detector.add(image)
    ...     if decision.accepted:
    ...         print(decision.query, decision.match, decision.score)
    """

    def __init__(
        self,
        config: Config | None = None,
        *,
        model: str | os.PathLike[str] | None = None,
        progress: Progress | None = None,
    ) -> None:
        header, arrays = store.load_arrays(model, kind="model") if model is not None else (None, {})
        self.config = _agreed_config(config, header, model)
        self.method: Method = build_method(self.config, progress=progress)
        self.learned_on: list[str] = []
        self._clock = Stopwatch("features", "learn", "describe", "match")
        self.frames: int
        self.scores: np.ndarray
        self._traverse: Traverse
        self._mean: np.ndarray | None = None  # mean descriptor of what the method was fitted on
        if header is not None:
            with store.damaged_is_an_error(model or ""):
                self._restore_method(header, arrays)
        self._warm_up = None if self.method.fitted else WarmUp(self.config)
        self._start(self._new_traverse(prior=self._mean))

    @property
    def one_stream(self) -> bool:
        """Whether candidates come from the drive itself, not from a reference traverse."""
        return self._traverse.one_stream

    @property
    def seconds(self) -> dict[str, float]:
        """Time spent so far in each stage."""
        return self._clock.seconds

    @property
    def threshold(self) -> float:
        """Least score of a loop."""
        chosen = self.config.decision.threshold
        return self.method.threshold if chosen is None else chosen

    @property
    def map_size(self) -> int:
        """Frames that the map holds."""
        return len(self._traverse.places)

    @property
    def map_bytes(self) -> int:
        """Bytes that the descriptors of the map take."""
        return self._traverse.places.nbytes

    def add(self, image: np.ndarray | None) -> Decision:
        """Take the next frame and decide.

        Parameters
        ----------
        image : ndarray of uint8, shape (h, w, 3), or None
            RGB; frames may differ in size. None for a frame that could not be read: it keeps its place.

        Returns
        -------
        Decision
            Its `query` counts the frames added so far, from 0.

        Raises
        ------
        ImageError
            If the array is no such image.
        FitError
            If the first frames are too few for the method to be fitted on them.
        """
        features = self._features(image)
        if self._warm_up is not None:
            self._learn(self._warm_up, features)
        query, self.frames = self.frames, self.frames + 1
        if not self.method.fitted:
            self.scores = np.full(query, np.nan, np.float32)
            return _no_candidate(query, Reason.UNREADABLE if image is None else Reason.WARMING_UP)
        self.scores = self._traverse.step(features)
        if image is None:
            self.scores = np.full_like(self.scores, np.nan)
        return self._decide(query, readable=image is not None)

    def detect(self, images: Iterable[np.ndarray | None]) -> Iterator[Decision]:
        """Yield the decision of each frame: `add` frame by frame.

        Decoding runs ahead where `images` has a length; a live source is asked for one image at a time.
        """
        for image in read_ahead(images) if isinstance(images, Sized) else images:
            yield self.add(image)

    def _decide(self, query: int, *, readable: bool) -> Decision:
        candidates = readable and not np.isnan(self.scores).all()
        match = int(np.nanargmax(self.scores)) if candidates else None
        run = self._traverse.consistency.push(match)
        if match is None:
            return _no_candidate(query, self._why_none(query) if readable else Reason.UNREADABLE)
        score = float(self.scores[match])
        if score < self.threshold:
            reason = Reason.BELOW_THRESHOLD
        else:
            reason = Reason.ACCEPTED if run >= self.config.decision.consistency else Reason.INCONSISTENT
        return Decision(query, match, score, reason is Reason.ACCEPTED, None, reason)

    def _why_none(self, query: int) -> Reason:
        old_enough = not self.one_stream or query >= self.config.sequence.exclude_recent
        return Reason.SEQUENCE_TOO_SHORT if old_enough else Reason.TOO_RECENT

    def set_reference(self, images: Frames, *, progress: Progress | None = None) -> None:
        """Look for loops against another traverse, and no longer within the drive.

        Parameters
        ----------
        images : sequence of (ndarray of uint8, shape (h, w, 3)) or None
            The reference traverse in order; None for a frame that could not be read. With nothing fitted yet the
            method is fitted on it.
        progress : callable, optional
            ``progress(done, total)`` in frames.
        """
        seen = {} if self.method.fitted else self._fit_on(images, source="reference traverse", progress=progress)
        recent: deque[np.ndarray] = deque(maxlen=self.method.window)
        described = []
        for index, image in enumerate(read_ahead(images)):
            features = seen[index] if index in seen else self._features(image)
            described.append(describe(self.method, features, recent))
            if progress:
                progress(index + 1, len(images))
        if not described:
            raise FitError("the reference traverse holds no frame")
        descriptors, mean = describe_traverse(self.method, self.config, described)
        places = self.method.new_map(exclude_recent=0)
        for descriptor in descriptors:
            places.add(descriptor)
        self._against(places, prior=mean)

    def use_map_as_reference(self, config: Config | None = None) -> None:
        """Start a new traverse whose candidates are the frames of the map, and only those.

        Parameters
        ----------
        config : Config, optional
            Settings from here on; those that the map was made with must not differ.
        """
        agreed = _agreed_config(config, self._header())
        if agreed.aggregation.centre_window != self.config.aggregation.centre_window:
            raise ModelError("the map was made with another aggregation.centre_window; leave that setting out")
        self.config = self.method.config = agreed
        if not self.map_size:
            raise FitError("the map is empty: add frames before it can serve as a reference")
        places = self.method.new_map(exclude_recent=0).restore(self._traverse.places.to_arrays())
        self._against(places, prior=self._traverse.mean)

    def fit(self, images: Frames, *, source: str, progress: Progress | None = None) -> None:
        """Fit the method on a traverse, in place of learning from the drive.

        Parameters
        ----------
        images : sequence of (ndarray of uint8, shape (h, w, 3)) or None
            At most ``learning.fit_frames`` of them, evenly spaced, are used.
        source : str
            What they are; kept in the model and in ``run.json``.
        progress : callable, optional
            ``progress(done, total)`` in frames.
        """
        seen = self._fit_on(images, source=source, progress=progress)
        self._warm_up = None
        self._mean = self._mean_of(list(seen.values()))
        self._start(self._new_traverse(prior=self._mean))

    def _features(self, image: np.ndarray | None) -> np.ndarray | None:
        with self._clock("features"):
            return None if image is None else self.method.features([check_image(image)])[0]

    def _new_traverse(self, *, reference: PlaceMap | None = None, prior: np.ndarray | None = None) -> Traverse:
        return Traverse(self.method, self.config, clock=self._clock, reference=reference, prior=prior)

    def _against(self, places: PlaceMap, *, prior: np.ndarray | None) -> None:
        self._warm_up = None
        self._start(self._new_traverse(reference=places, prior=prior))

    def _start(self, traverse: Traverse) -> None:
        self.frames = 0
        self.scores = np.zeros(0, np.float32)
        self._traverse = traverse

    def _mean_of(self, features: list[np.ndarray]) -> np.ndarray | None:
        recent: deque[np.ndarray] = deque(maxlen=self.method.window)
        described = [describe(self.method, item, recent) for item in features]
        return describe_traverse(self.method, self.config, described)[1]

    def _learn(self, warm_up: WarmUp, features: np.ndarray | None) -> None:
        """At a milestone of the warm-up, fit on the frames so far and go through them again, from their features."""
        if warm_up.push(features):
            try:
                with self._clock("learn"):
                    self.method.fit(warm_up.readable)
            except LoopClosureError:
                warm_up.take_back()
                raise
            warm_up.fit_done()
            unreadable = len(warm_up.kept) - len(warm_up.readable)
            without = f", {unreadable} of them unreadable" if unreadable else ""
            self.learned_on.append(f"frames 0 to {len(warm_up.kept) - 1} of the drive{without}")
            before = self._traverse
            self._traverse = self._new_traverse(prior=self._mean_of(warm_up.readable))
            self._traverse.consistency = before.consistency  # what was decided stays decided
            for item in warm_up.kept[:-1]:
                self._traverse.step(item)
        if warm_up.finished:
            self._warm_up = None

    def _fit_on(self, images: Frames, *, source: str, progress: Progress | None) -> dict[int, np.ndarray]:
        """Fit the method on evenly spaced frames and return the features of these, by index."""
        learning = self.config.learning
        first = self._features(next((image for image in images if image is not None), None))
        if first is None:
            raise FitError(f"none of the {len(images)} frames of the {source} can be read: nothing to fit on")
        most = max(2, min(learning.fit_frames, int(learning.max_kept_mb * 1e6 / first.nbytes)))
        chosen = _evenly_spaced(len(images), most)
        seen = {}
        for index, image in read_ahead(_at(images, chosen)):
            features = self._features(image)
            if features is not None:
                seen[index] = features
            if progress:
                progress(index + 1, len(images))
        seen = seen or {0: first}
        with self._clock("learn"):
            self.method.fit(list(seen.values()))
        self.learned_on = [f"{len(seen)} of {len(images)} frames of the {source}"]
        return seen

    def save_model(self, folder: str | os.PathLike[str]) -> Path:
        """Write what was learned, without the map; ``LoopDetector(model=folder)`` starts with it."""
        if not self.method.fitted:
            raise FitError("nothing was fitted yet: no model to save")
        return store.save_arrays(folder, kind="model", header=self._header(), arrays=self._learned_arrays())

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write the whole detector; `load` brings it back as if it had never stopped."""
        parts = {
            "method": self._learned_arrays() if self.method.fitted else {},
            "traverse": self._traverse.to_arrays(),
            "warm_up": self._warm_up.to_arrays() if self._warm_up else {},
        }
        header = self._header() | {
            "frames": self.frames,
            "one_stream": self.one_stream,
            "fitted": self.method.fitted,
            "warming_up": self._warm_up is not None,
        }
        arrays = {f"{name}.{key}": array for name, items in parts.items() for key, array in items.items()}
        return store.save_arrays(folder, kind="detector", header=header, arrays=arrays)

    @classmethod
    def load(cls, folder: str | os.PathLike[str], *, progress: Progress | None = None) -> LoopDetector:
        """Bring back a detector that `save` wrote.

        Raises
        ------
        ModelError
            If the folder holds no detector of this format, or its weights are not the ones it was made with.
        """
        header, arrays = store.load_arrays(folder, kind="detector")
        with store.damaged_is_an_error(folder):
            return cls._rebuilt(header, arrays, progress)

    @classmethod
    def _rebuilt(
        cls, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], progress: Progress | None
    ) -> LoopDetector:
        detector = cls(Config.from_dict(header["config"]), progress=progress)
        if header["fitted"]:
            detector._restore_method(header, store.part(arrays, "method"))
        state = store.part(arrays, "traverse")
        reference = None
        if not header["one_stream"]:
            reference = detector.method.new_map(exclude_recent=0)
        detector._start(detector._new_traverse(reference=reference).restore(state))
        detector.frames = int(header["frames"])
        detector._warm_up = None
        if header["warming_up"]:
            detector._warm_up = WarmUp(detector.config).restore(store.part(arrays, "warm_up"))
        return detector

    def _learned_arrays(self) -> dict[str, np.ndarray]:
        return self.method.to_arrays() | ({} if self._mean is None else {_MEAN: self._mean})

    def _header(self) -> dict[str, Any]:
        return {
            "config": self.config.model_dump(),
            "learned_on": self.learned_on,
            "provenance": self.method.provenance,
        }

    def _restore_method(self, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        if header["provenance"] != self.method.provenance:
            raise ModelError(
                f"fitted with {header['provenance']}, here are {self.method.provenance}; fetch those weights"
            )
        self.method.restore({name: array for name, array in arrays.items() if name != _MEAN})
        self._mean = arrays.get(_MEAN)
        self.learned_on = list(header["learned_on"])


def _agreed_config(
    config: Config | None, header: Mapping[str, Any] | None, folder: str | os.PathLike[str] | None = None
) -> Config:
    """Return the configuration, which must not contradict a model on anything that the model was fitted for."""
    if header is None:
        return config or Config()
    fitted = store.saved_config(header, folder or "the model")
    if config is None:
        return fitted
    wanted, found = config.flat(), fitted.flat()
    free = ("images.", "learning.", "sequence.", "decision.", "aggregation.centre_window")
    binding = [name for name in wanted if not name.startswith(free)]
    if fitted.compression.reading == "sequence":
        binding.append("sequence.length")
    for name in binding:
        if wanted[name] != found[name]:
            raise ModelError(
                f"the model was fitted with {name} = {found[name]}, wanted {wanted[name]}; "
                "leave that setting out or fit again with it"
            )
    return config


def _no_candidate(query: int, reason: Reason) -> Decision:
    return Decision(query, None, None, accepted=False, inliers=None, reason=reason)


def _evenly_spaced(count: int, most: int) -> list[int]:
    return sorted({round(position) for position in np.linspace(0, count - 1, min(count, most))})


def _at(images: Frames, chosen: list[int]) -> Iterator[tuple[int, np.ndarray | None]]:
    """Yield the chosen frames; a video is read through once, because a jump in it costs a decoder of its own."""
    if getattr(images, "is_video", False):
        wanted = set(chosen)
        yield from ((index, image) for index, image in enumerate(images) if index in wanted)
    else:
        yield from ((index, images[index]) for index in chosen)
