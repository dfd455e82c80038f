"""LoopDetector: images in, decisions out. Each stage is a line of `LoopDetector._step`, in the order of the paper."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sized
from pathlib import Path
from typing import Any

import numpy as np

from loopclosure import store
from loopclosure.config import Config
from loopclosure.decision import Evidence, Judge, new_views
from loopclosure.errors import FitError, LoopClosureError, ModelError
from loopclosure.matching.scored import Scored
from loopclosure.methods import Method, PlaceMap, build_method
from loopclosure.perception import Frames, Perception, Seen
from loopclosure.records import Decision, Reason
from loopclosure.timing import Stopwatch
from loopclosure.traverse import Traverse, describe, describe_traverse
from loopclosure.verification import Verifier, Views
from loopclosure.warmup import WarmUp

_MEAN = "mean_of_fit"  # beside the arrays of a method
Progress = Callable[[int, int], None]


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
        Folder that `save_model`, ``loopclosure fit`` or ``loopclosure train`` wrote.
    progress : callable, optional
        ``progress(done, total)`` in bytes, where weights have to be downloaded.

    Attributes
    ----------
    method : Method
        What describes and compares images.
    frames : int
        Frames added so far.
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
        self.config = store.agreed_config(config, header, model)
        self.method: Method = build_method(self.config, progress=progress)
        self.learned_on: list[str] = []
        self._clock = Stopwatch("features", "picture", "learn", "describe", "match", "decide")
        self.frames: int
        self._scored: Scored
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
        return self._judge.threshold

    @property
    def verifier(self) -> Verifier | None:
        """What verifies candidates; None where nothing is verified."""
        return None if self._judge.views is None else self._judge.views.verifier

    @property
    def evidence(self) -> tuple[Evidence, ...]:
        """What spoke for each candidate of the last frame, best first."""
        return self._judge.evidence

    @property
    def scores(self) -> np.ndarray:
        """Sequence score of the last frame to each frame of the map, float32 (n,); NaN where that is no candidate.

        In a map that has outgrown ``matching.flat_up_to`` it is also NaN for frames that the index did not find.
        """
        return self._scored.row()

    @property
    def map_size(self) -> int:
        """Frames that the map holds."""
        return len(self._traverse.places)

    @property
    def map_bytes(self) -> int:
        """Bytes that the map takes: its descriptors, and the pictures that loops are verified by."""
        views = self._judge.places
        return self._traverse.places.nbytes + (0 if views is None else views.nbytes)

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
        return self._step(self._perception.look(self.frames, image))

    def detect(self, images: Iterable[np.ndarray | None]) -> Iterator[Decision]:
        """Yield the decision of each frame: what `add` says, frame by frame.

        Where `images` has a length, decoding runs ahead, features are computed in batches, and matching goes on
        meanwhile; a live source is asked for one image at a time.
        """
        if isinstance(images, Sized):
            frames = enumerate(self._perception.as_needed(images), self.frames)
            yield from (self._step(view) for _, view in self._perception.look_ahead(frames))
        else:
            yield from map(self.add, images)

    def _step(self, view: Seen) -> Decision:
        features, readable = view.features, view.features is not None
        self._judge.see(self.frames, view.picture)
        if self._warm_up is not None:
            self._learn(self._warm_up, features)
        query, self.frames = self.frames, self.frames + 1
        if not self.method.fitted:
            self._scored = Scored.nothing(query)
            return Decision(query, None, None, False, None, Reason.WARMING_UP if readable else Reason.UNREADABLE)
        compared_with = self.map_size
        scored = self._traverse.step(features)
        self._scored = scored if readable else Scored.nothing(compared_with)
        with self._clock("decide"):
            return self._judge.decide(query, self._scored, readable=readable, nearest=self._traverse.nearest)

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
        views = new_views(self.config, self.method)
        places = self.method.new_map(exclude_recent=0)
        described: list[np.ndarray] = []  # what is centred waits here for the mean of all
        keep = described.append if self.method.centred else places.add
        unseen = ((i, None if i in seen else image) for i, image in enumerate(self._perception.as_needed(images)))
        for index, looked in self._perception.look_ahead(unseen):
            view = seen.get(index, looked)
            keep(describe(self.method, view.features, recent))
            if views is not None and views.wanted(index):
                views.add(view.picture)
            if progress:
                progress(index + 1, len(images))
        if not described and not len(places):
            raise FitError("the reference traverse holds no frame")
        mean = None
        if described:
            descriptors, mean = describe_traverse(self.method, self.config, described)
            for descriptor in descriptors:
                places.add(descriptor)
        self._against(places, views, prior=mean)

    def use_map_as_reference(self, config: Config | None = None) -> None:
        """Start a new traverse whose candidates are the frames of the map, and only those.

        Parameters
        ----------
        config : Config, optional
            Settings from here on; those that the map was made with must not differ.
        """
        agreed = store.agreed_config(config, self._header())
        if agreed.aggregation.centre_window != self.config.aggregation.centre_window:
            raise ModelError("the map was made with another aggregation.centre_window; leave that setting out")
        self.config = self.method.config = agreed
        if not self.map_size:
            raise FitError("the map is empty: add frames before it can serve as a reference")
        places = self.method.new_map(exclude_recent=0).restore(self._traverse.places.to_arrays())
        self._against(places, self._judge.places, prior=self._traverse.mean)

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
        self._mean = self._mean_of([view.features for view in seen.values() if view.features is not None], apart=True)
        self._start(self._new_traverse(prior=self._mean))

    def _new_traverse(self, *, reference: PlaceMap | None = None, prior: np.ndarray | None = None) -> Traverse:
        return Traverse(self.method, self.config, clock=self._clock, reference=reference, prior=prior)

    def _against(self, places: PlaceMap, views: Views | None, *, prior: np.ndarray | None) -> None:
        self._warm_up = None
        self._start(self._new_traverse(reference=places, prior=prior), views)

    def _start(self, traverse: Traverse, reference: Views | None = None) -> None:
        self.frames = 0
        self._scored = Scored.nothing(0)
        self._traverse = traverse
        self._judge = Judge(self.config, self.method, one_stream=traverse.one_stream, reference=reference)
        self._perception = Perception(self.method, self._judge.views, self._clock)

    def _mean_of(self, features: list[np.ndarray], *, apart: bool = False) -> np.ndarray | None:
        """Return the mean descriptor of frames that follow each other, or lie far apart."""
        alone = apart and not self.method.whole_sequences
        recent: deque[np.ndarray] = deque(maxlen=1 if alone else self.method.window)
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
            self._traverse = self._new_traverse(prior=self._mean_of(warm_up.readable))
            for item in warm_up.kept[:-1]:
                self._traverse.step(item)
        if warm_up.finished:
            self._warm_up = None

    def _fit_on(self, images: Frames, *, source: str, progress: Progress | None) -> dict[int, Seen]:
        """Fit the method on evenly spaced frames and return what was seen in these, by index."""
        images = self._perception.as_needed(images)
        learning = self.config.learning
        at, first = next(((i, image) for i, image in enumerate(images) if image is not None), (0, None))
        looked = self._perception.look(at, first)
        if looked.features is None:
            raise FitError(f"none of the {len(images)} frames of the {source} can be read: nothing to fit on")
        most = max(2, min(learning.fit_frames, int(learning.max_kept_mb * 1e6 / looked.features.nbytes)))
        chosen = _evenly_spaced(len(images), most)
        seen = {}
        for index, view in self._perception.look_at_some(images, chosen):
            if view.features is not None:
                seen[index] = view
            if progress:
                progress(index + 1, len(images))
        seen = seen or {at: looked}
        with self._clock("learn"):
            self.method.fit([view.features for view in seen.values() if view.features is not None])
        self.learned_on = [f"{len(seen)} of {len(images)} frames of the {source}"]
        return seen

    def save_model(self, folder: str | os.PathLike[str]) -> Path:
        """Write what was learned, without the map; ``LoopDetector(model=folder)`` starts with it."""
        if not self.method.fitted:
            raise FitError("nothing was fitted yet: no model to save")
        return store.save_arrays(folder, kind="model", header=self._header(folder), arrays=self._learned_arrays())

    def save(self, folder: str | os.PathLike[str]) -> Path:
        """Write the whole detector; `load` brings it back as if it had never stopped."""
        parts = {
            "method": self._learned_arrays() if self.method.fitted else {},
            "traverse": self._traverse.to_arrays(),
            "judge": self._judge.to_arrays(),
            "warm_up": self._warm_up.to_arrays() if self._warm_up else {},
        }
        header = self._header(folder) | {
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
            return cls._rebuilt(store.saved_config(header, folder), header, arrays, progress)

    @classmethod
    def _rebuilt(
        cls, config: Config, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray], progress: Progress | None
    ) -> LoopDetector:
        detector = cls(config, progress=progress)
        detector._restore_method(header, store.part(arrays, "method"))
        state = store.part(arrays, "traverse")
        reference = None
        if not header["one_stream"]:
            reference = detector.method.new_map(exclude_recent=0)
        judge = store.part(arrays, "judge")
        kept = store.part(judge, "places")
        views = new_views(config, detector.method) if kept else None
        if views is not None:
            views.restore(kept)
        detector._start(detector._new_traverse(reference=reference).restore(state), views)
        detector._judge.restore(judge)
        detector.frames = int(header["frames"])
        detector._warm_up = None
        if header["warming_up"]:
            detector._warm_up = WarmUp(detector.config).restore(store.part(arrays, "warm_up"))
        return detector

    def _learned_arrays(self) -> dict[str, np.ndarray]:
        return self.method.to_arrays() | ({} if self._mean is None else {_MEAN: self._mean})

    def _header(self, folder: str | os.PathLike[str] | None = None) -> dict[str, Any]:
        config = self.config if folder is None else store.carry_weights(self.config, folder)
        return {
            "config": config.model_dump(),
            "learned_on": self.learned_on,
            "provenance": self.method.provenance,
        }

    def _restore_method(self, header: Mapping[str, Any], arrays: Mapping[str, np.ndarray]) -> None:
        if header["provenance"] != self.method.provenance:
            raise ModelError(
                f"fitted with {header['provenance']}, here are {self.method.provenance}; fetch those weights"
            )
        if not header.get("fitted", True):  # a trained network alone
            return
        self.method.restore({name: array for name, array in arrays.items() if name != _MEAN})
        self._mean = arrays.get(_MEAN)
        self.learned_on = list(header["learned_on"])


def _evenly_spaced(count: int, most: int) -> list[int]:
    return sorted({round(position) for position in np.linspace(0, count - 1, min(count, most))})
