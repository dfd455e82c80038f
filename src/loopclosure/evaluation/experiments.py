"""The paper's experiments on a data set: Tables 4 to 7, and what Figures 12 and 17 to 23 show."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, Literal

from loopclosure import __version__
from loopclosure.config import EMBEDDED, METHOD_SETTINGS, Config
from loopclosure.detect import LoopDetector
from loopclosure.errors import ConfigError, ImageError, WeightsError
from loopclosure.evaluation import paper
from loopclosure.evaluation.cache import MapCache, digest, image_paths
from loopclosure.evaluation.compare import MethodResult, judge_run, method_names, network_name, replaceable, run_method
from loopclosure.evaluation.grid import Cell, fill_grid
from loopclosure.evaluation.machine import describe_machine
from loopclosure.evaluation.metrics import PrecisionRecall
from loopclosure.evaluation.protocol import evaluate
from loopclosure.evaluation.truth import Truth, View, load_truth
from loopclosure.images.datasets import open_dataset
from loopclosure.images.sequence import ImageSequence
from loopclosure.methods import METHODS
from loopclosure.runs import RUN, RunProgress, write_whole
from loopclosure.weights import RANDOM, WEIGHTS, is_cached, locate, weights_for

Views = Literal["left", "right", "both", "all"]
_CAMERAS: dict[str, tuple[View, ...]] = {
    "both": ("left", "right"),
    "left": ("left",),
    "right": ("right",),
    "all": ("all",),
}
_POSITIONS = {"left": slice(0, None, 2), "right": slice(1, None, 2), "all": slice(None)}
_TIMED = 40  # frames on which the time of the paper's own method is taken
RESULT = "result.json"


@dataclass(frozen=True)
class GridResult:
    """A cell of the grid with its accuracy."""

    cell: Cell
    metrics: Mapping[str, Any]
    curve: PrecisionRecall
    paper: float | None


@dataclass(frozen=True)
class Experiment:
    """All experiments on one camera.

    Attributes
    ----------
    view : str
        ``left`` or ``right`` of a stereo set, otherwise ``all``.
    frames : int
        Images.
    truth : Truth
        For these images.
    grid : tuple of GridResult
        Layer by layer: without the transform, then by rising ratio.
    methods : tuple of MethodResult
        Every method that was asked for, as ``loopclosure compare`` runs it.
    milliseconds : dict of float to float
        Time an image of the paper's own method, by its ratio.
    """

    view: str
    frames: int
    truth: Truth
    grid: tuple[GridResult, ...]
    methods: tuple[MethodResult, ...]
    milliseconds: Mapping[float, float]


@dataclass(frozen=True)
class Reproduction:
    """Result of `reproduce`.

    Attributes
    ----------
    name : str
        Of the data set.
    source : str
        Its images.
    config : Config
        With which the grid was filled.
    weights : str
        Name of the weights of its network.
    weights_sha256 : str or None
        Of their file; None for random weights.
    note : str
        Why the embedded network stands in for the one that was wanted.
    layers : tuple of str
        Taps of the network.
    experiments : tuple of Experiment
        One a camera.
    computed : int
        Frames that passed the network in this call; 0 if all feature maps were found.
    limit : int or None
        Only so many first frames were used.
    machine : str
        Where times were measured.
    """

    name: str
    source: str
    config: Config
    weights: str
    weights_sha256: str | None
    note: str
    layers: tuple[str, ...]
    experiments: tuple[Experiment, ...]
    computed: int
    limit: int | None
    machine: str

    @property
    def network(self) -> str:
        """Name of the network and its weights."""
        return network_name(self.config.features.backbone, self.weights)

    @property
    def random(self) -> bool:
        """Whether the network was never trained."""
        return self.config.features.weights == RANDOM


def reproduce(
    name: str,
    out: str | os.PathLike[str],
    *,
    images: str | os.PathLike[str] | None = None,
    truth: str | os.PathLike[str] | None = None,
    truth_settings: Mapping[str, Any] | None = None,
    config: Config | None = None,
    layers: Sequence[str] = (),
    view: Views | None = None,
    tolerance: int | None = None,
    methods: str | Sequence[str] = "all",
    limit: int | None = None,
    progress: RunProgress | None = None,
) -> Reproduction:
    """Do the paper's experiments; what was finished in `out` before is not done again.

    Parameters
    ----------
    name : str
        ``new-college``, ``city-centre``, or any name for data of your own.
    out : path
        Feature maps, finished cells and run folders lie here.
    images, truth : path, optional
        A folder or a text file of paths, and a truth file. Of the two named sets the folder may be the whole set, and
        without it the cache is looked at; data of your own want both.
    truth_settings : mapping, optional
        ``key``, ``radius_m`` and ``nan_poses`` of `load_truth`.
    config : Config, optional
        The paper's settings if absent. Where the default weights of its network are not to be had, the embedded
        network stands in.
    layers : sequence of str
        Taps; all that the network has if empty.
    view : {'left', 'right', 'both', 'all'}, optional
        Cameras of a set of left and right images by turns; both cameras of the named sets, all images of your own.
    tolerance : int, optional
        A match so many frames from a true one is right; 0 if the data set has no custom.
    methods : str or sequence of str
        As for `compare_methods`; ``none`` for the grid alone.
    limit : int, optional
        Use only so many first frames of each camera.
    progress : callable, optional
        ``progress(stage, done, total)``.

    Returns
    -------
    Reproduction

    Raises
    ------
    LoopClosureError
        If the images, the truth, a setting or the weights cannot be used.
    """
    names = [] if methods == "none" else method_names(methods)
    if limit is not None and limit < 2:
        raise ConfigError(f"limit is {limit}, wanted at least 2 frames")
    data = _open(name, images, truth, truth_settings)
    config, note = _with_weights(config or Config.preset("paper"), progress)
    known = _all_layers(config)
    layers = tuple(sorted(set(layers), key=lambda layer: known.index(layer) if layer in known else 0)) or known
    bench = _Bench(data, Path(out), config, layers, names, data.tolerance if tolerance is None else tolerance, limit)
    experiments = [bench.run(camera, progress) for camera in _cameras(data, view)]
    record = weights_for(config.features.backbone, config.features.weights)
    return Reproduction(
        name=name,
        source=str(data.images.source),
        config=config,
        weights=record.name,
        weights_sha256=bench.weights_sha256,
        note=note,
        layers=layers,
        experiments=tuple(experiments),
        computed=bench.computed,
        limit=limit,
        machine=describe_machine(),
    )


@dataclass(frozen=True)
class _Data:
    """Images and truth of all cameras."""

    name: str
    images: ImageSequence
    truth: Path
    settings: dict[str, Any]
    tolerance: int


def _open(
    name: str,
    images: str | os.PathLike[str] | None,
    truth: str | os.PathLike[str] | None,
    settings: Mapping[str, Any] | None,
) -> _Data:
    settings = {key: value for key, value in (settings or {}).items() if value is not None}
    if name in paper.SETS:
        opened = open_dataset(name, images, view="all", truth=truth, truth_settings=settings)
        if opened.truth_path is None:
            raise ConfigError(f"{name} has no truth in this folder; give it with --truth")
        settings = {key: value for key, value in opened.truth_settings.items() if key != "view"}
        return _Data(name, opened.images, opened.truth_path, settings, opened.tolerance)
    if images is None or truth is None:
        raise ConfigError(
            f"'{name}' is none of the paper's data sets ({', '.join(paper.SETS)}), "
            "so it wants both: --images (a folder or a text file of paths) and --truth"
        )
    return _Data(name, ImageSequence(images), Path(truth), settings, 0)


def _cameras(data: _Data, view: str | None) -> tuple[View, ...]:
    if view is None:
        view = "both" if data.name in paper.SETS else "all"
    if view not in _CAMERAS:
        raise ConfigError(f"view is '{view}', wanted one of {', '.join(_CAMERAS)}")
    if view != "all" and len(data.images) % 2:
        raise ConfigError(
            f"{data.images.source} has {len(data.images)} images, wanted an even number: "
            "left and right by turns are asked for"
        )
    return _CAMERAS[view]


def _with_weights(config: Config, progress: RunProgress | None) -> tuple[Config, str]:
    """Return the configuration of a network whose weights are here, and why it is not the one that was wanted."""
    record = weights_for(config.features.backbone, config.features.weights)
    report = partial(progress, "downloading weights") if progress else None
    try:
        if not record.random:
            locate(record, progress=report)
    except WeightsError as error:
        if not replaceable(config):
            raise
        return config.with_settings({"features.backbone": EMBEDDED}), str(error)
    return config, ""


def _all_layers(config: Config) -> tuple[str, ...]:
    from loopclosure.features.backbones import BACKBONES

    if config.features.backbone not in BACKBONES:
        raise ConfigError(f"{config.features.backbone} has no layers to compare; known: {', '.join(BACKBONES)}")
    return BACKBONES[config.features.backbone].layers


class _Bench:
    """The experiments of one data set, camera by camera."""

    def __init__(
        self,
        data: _Data,
        out: Path,
        config: Config,
        layers: tuple[str, ...],
        methods: list[str],
        tolerance: int,
        limit: int | None,
    ) -> None:
        self.data, self.out, self.config, self.layers = data, out, config, layers
        self.methods, self.tolerance, self.limit = methods, tolerance, limit
        self.computed = 0
        self.weights_sha256: str | None = None

    def run(self, view: View, progress: RunProgress | None) -> Experiment:
        images = self._images(view)
        truth = self._truth(view, len(images))
        report = partial(_of_camera, view, progress) if progress and view != "all" else progress
        maps = MapCache(self.out / "features", images, self.config.features, self.layers)
        maps.fill(report)
        self.computed += maps.computed
        self.weights_sha256 = maps.weights_sha256
        cells = fill_grid(maps, (None, *paper.GAMMAS), self.config, self.out / "cells", progress=report)
        return Experiment(
            view,
            len(images),
            truth,
            tuple(self._judge(cell, truth) for cell in cells),
            tuple(self._method(name, images, maps.hashes, truth, report) for name in self.methods),
            self._times(images, maps.hashes, report),
        )

    def _images(self, view: View) -> ImageSequence:
        """Return the images of one camera, by a list of their paths where they are not all that there are."""
        images = self.data.images
        if view == "all" and (self.limit is None or self.limit >= len(images)):
            return images
        paths = image_paths(images)[_POSITIONS[view]][: self.limit]
        self.out.mkdir(parents=True, exist_ok=True)
        file = self.out / f"frames-{view}.txt"
        write_whole(file, "".join(f"{path}\n" for path in paths))
        return ImageSequence(file)

    def _truth(self, view: View, frames: int) -> Truth:
        """Return the truth of one camera: a file for both cameras is cut to one, and to the first frames."""
        whole, settings = len(self.data.images), self.data.settings
        camera = len(range(whole)[_POSITIONS[view]])
        load = partial(load_truth, self.data.truth, exclude_recent=self.config.sequence.exclude_recent, **settings)
        both = view != "all" and load().n_queries > camera
        truth = load(frames=(camera, None), view=view if both else "all")
        if frames == camera:
            return truth
        return replace(truth, pairs=truth.pairs[:frames, :frames], ignored=truth.ignored[:frames, :frames])

    def _judge(self, cell: Cell, truth: Truth) -> GridResult:
        metrics, curve = evaluate(cell.log(self.config), truth, tolerance=self.tolerance)
        backbone = self.config.features.backbone
        return GridResult(cell, metrics, curve, paper.recall_of_layer(self.data.name, backbone, cell.layer, cell.gamma))

    def _method(
        self, name: str, images: ImageSequence, hashes: list[str], truth: Truth, progress: RunProgress | None
    ) -> MethodResult:
        """Run a method as ``loopclosure compare`` does, or read what an earlier call left."""
        config = method_config(name, self.config)
        given = None if config.features.weights == "default" else self.weights_sha256
        made_by = digest([config.with_settings({"method": name}).model_dump(mode="json"), given, hashes, __version__])
        folder = self.out / "methods" / f"{name}-{made_by}"
        found = _finished(name, folder, truth, self.tolerance)
        if found is not None:
            return found
        result = run_method(
            name, images.source, truth, folder, config=config, tolerance=self.tolerance, progress=progress
        )
        if result.metrics is not None:
            write_whole(folder / RESULT, json.dumps({"mark": result.mark, "note": result.note}) + "\n")
        return result

    def _times(self, images: ImageSequence, hashes: list[str], progress: RunProgress | None) -> dict[float, float]:
        """Return the milliseconds an image of the last layer at the two ratios of Table 6, measured once."""
        times = {}
        for gamma in (paper.TEXT_GAMMA, paper.FIGURE_GAMMA):
            config = self.config.with_settings({"features.layer": self.layers[-1], "compression.gamma": gamma})
            made_by = digest([config.model_dump(mode="json"), hashes, describe_machine()])
            file = self.out / "times" / f"{made_by}.json"
            if not file.is_file():
                file.parent.mkdir(parents=True, exist_ok=True)
                write_whole(file, json.dumps({"ms_an_image": _time(config, images, progress)}) + "\n")
            times[gamma] = float(json.loads(file.read_text(encoding="utf-8"))["ms_an_image"])
        return times


def method_config(method: str, config: Config) -> Config:
    """Return the shipped settings of a method, with the size, the sequences and the exclusion of the experiment.

    Weights that were given are for the methods whose own network is the one that they were given for.
    """
    kept = ("features.height", "features.width", "aggregation.clusters")
    settings = {
        name: value
        for name, value in config.flat().items()
        if name in kept or name.startswith(("images.", "learning.", "sequence."))
    }
    if METHOD_SETTINGS.get(method, {}).get("features.backbone") == config.features.backbone:
        settings["features.weights"] = config.features.weights
    return Config().with_settings(settings)


def _finished(method: str, folder: Path, truth: Truth, tolerance: int) -> MethodResult | None:
    """Return the result of a finished run; None if there is none, or if the weights that it lacked are here now."""
    if not (folder / RESULT).is_file():
        return None
    said = json.loads((folder / RESULT).read_text(encoding="utf-8"))
    weights = METHODS[method].weights
    if said["note"] and weights in WEIGHTS and is_cached(weights):
        return None
    info = json.loads((folder / RUN).read_text(encoding="utf-8"))
    return judge_run(method, folder, info, truth, tolerance=tolerance, mark=said["mark"], note=said["note"])


def _time(config: Config, images: ImageSequence, progress: RunProgress | None) -> float:
    """Return the milliseconds an image of a fitted detector, one image at a time, without decoding."""
    frames = min(len(images), _TIMED)
    first = [images[frame] for frame in range(frames)]
    if any(image is None for image in first):
        raise ImageError(f"{images.source} holds images that cannot be read; leave them out")
    detector = LoopDetector(config)
    detector.fit(first, source="first images")
    fitted = sum(detector.seconds.values())
    for done, _ in enumerate(detector.detect(first), start=1):
        if progress:
            progress("taking the time", done, frames)
    return 1000 * (sum(detector.seconds.values()) - fitted) / frames


def _of_camera(view: str, progress: RunProgress, stage: str, done: int, total: int) -> None:
    progress(f"{view}: {stage}", done, total)
