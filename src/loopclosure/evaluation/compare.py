"""Several methods on one sequence: the same images, exclusion, sequences and evaluation for all of them."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

from loopclosure.config import EMBEDDED, METHOD_SETTINGS, Config
from loopclosure.errors import ConfigError, LoopClosureError, WeightsError, did_you_mean
from loopclosure.evaluation.log import read_loops
from loopclosure.evaluation.machine import describe_machine
from loopclosure.evaluation.metrics import PrecisionRecall
from loopclosure.evaluation.protocol import evaluate
from loopclosure.evaluation.truth import Truth, load_truth
from loopclosure.images.sequence import ImageSequence
from loopclosure.methods import METHODS
from loopclosure.runs import Run, RunProgress, detect_loops, write_whole
from loopclosure.store import HEADER
from loopclosure.weights import RANDOM

METRICS = "metrics.json"


@dataclass(frozen=True)
class MethodResult:
    """What one method came to.

    Attributes
    ----------
    method : str
        Its name.
    metrics : dict or None
        Content of ``metrics.json``; None if the method could not run.
    curve : PrecisionRecall or None
        Precision over recall.
    milliseconds : float or None
        Time an image: features, descriptor and search, without reading and learning.
    info : dict
        Content of ``run.json``; empty if the method could not run.
    mark : str
        What the numbers are not: ``random weights``, or which network stands in for the method's own.
    note : str
        Why it could not run, or why another network stands in, and what to do.
    """

    method: str
    metrics: Mapping[str, Any] | None = None
    curve: PrecisionRecall | None = None
    milliseconds: float | None = None
    info: Mapping[str, Any] = field(default_factory=dict)
    mark: str = ""
    note: str = ""

    @property
    def network(self) -> str:
        """Which network made the features, with which weights; empty where there is none."""
        weights = self.info["weights"].get("weights") if self.info else None
        return network_name(self.info["config"]["features"]["backbone"], weights) if weights else ""


@dataclass(frozen=True)
class Comparison:
    """Result of `compare_methods`.

    Attributes
    ----------
    results : tuple of MethodResult
        In the order in which they were asked for.
    source, reference : str
        What was compared; `reference` is empty in one stream.
    frames, references : int
        Frames of both; `references` is 0 in one stream.
    protocol : dict
        The rules under which all numbers hold.
    machine : str
        Where the times were measured.
    """

    results: tuple[MethodResult, ...]
    source: str
    reference: str
    frames: int
    references: int
    protocol: Mapping[str, Any]
    machine: str


def compare_methods(
    source: str | os.PathLike[str],
    truth: str | os.PathLike[str] | Truth,
    out: str | os.PathLike[str],
    *,
    methods: str | Sequence[str] = "all",
    reference: str | os.PathLike[str] | None = None,
    config: Config | None = None,
    backbone: str | None = None,
    weights: Mapping[str, str] | None = None,
    models: Mapping[str, str | os.PathLike[str]] | None = None,
    tolerance: int = 0,
    truth_settings: Mapping[str, Any] | None = None,
    progress: RunProgress | None = None,
) -> Comparison:
    """Run several methods on one sequence, or on one traverse against another, and judge them by one truth.

    Parameters
    ----------
    source : path
        Folder of images, text file of paths, or video.
    truth : path or Truth
        What `load_truth` reads, with `truth_settings`.
    out : path
        Each method's run folder is ``out/METHOD``.
    methods : str or sequence of str
        Names of `loopclosure.methods.METHODS`, or ``all`` of them.
    reference : path, optional
        The other traverse.
    config : Config, optional
        Settings of all methods. What a method's name says of its network goes before it.
    backbone : str, optional
        The network of every method that runs on feature maps, whatever its name says.
    weights : mapping, optional
        Weights of single methods by their names, as for ``features.weights``.
    models : mapping, optional
        Folders of fitted models by the names of their methods; the others learn from the reference or the drive.
    tolerance : int
        A match so many frames from a true one is right.
    truth_settings : mapping, optional
        ``view``, ``key``, ``radius_m`` and ``nan_poses`` of `load_truth`.
    progress : callable, optional
        ``progress(stage, done, total)``.

    Returns
    -------
    Comparison
        Where the weights of a method are not to be had, the embedded network stands in for its own, and the result
        says so. A method that cannot run at all has a result without numbers that says why; the others go on.

    Raises
    ------
    LoopClosureError
        If the images, the truth or the name of a method cannot be used.
    """
    config = config or Config()
    weights, models = weights or {}, models or {}
    names = method_names(methods)
    for name in (*weights, *models):
        if name not in names:
            raise ConfigError(f"'{name}' is not among the methods {', '.join(names)}{did_you_mean(name, names)}")
    size = _frames(source, reference, config)
    judged = truth if isinstance(truth, Truth) else _truth(truth, size, config, truth_settings)
    results = [
        run_method(
            name,
            source,
            judged,
            Path(out) / name,
            reference=reference,
            config=config.with_settings({"features.weights": weights[name]}) if name in weights else config,
            backbone=backbone,
            model=models.get(name),
            tolerance=tolerance,
            progress=progress,
        )
        for name in names
    ]
    return Comparison(
        tuple(results),
        source=str(source),
        reference="" if reference is None else str(reference),
        frames=size[0],
        references=size[1] or 0,
        protocol=next((dict(result.metrics["protocol"]) for result in results if result.metrics), {}),
        machine=describe_machine(),
    )


def network_name(backbone: str, weights: str) -> str:
    """Return what a network is called; most names of weights begin with that of their network.

    Examples
    --------
    >>> network_name("resnet152", "random (seed 0)"), network_name("vgg16", "vgg16-imagenet1k-v1")
    ('resnet152, random (seed 0)', 'vgg16-imagenet1k-v1')
    """
    return weights if weights.startswith(backbone) else f"{backbone}, {weights}"


def method_names(methods: str | Sequence[str]) -> list[str]:
    """Return the names of methods, which may be given as ``"all"`` or ``"a,b,c"``.

    Raises
    ------
    ConfigError
        For an unknown name, with the nearest known one.

    Examples
    --------
    >>> method_names("seqslam, kl-netvlad")
    ['seqslam', 'kl-netvlad']
    """
    if methods == "all":
        return list(METHODS)
    given = methods.split(",") if isinstance(methods, str) else methods
    names = list(dict.fromkeys(filter(None, (name.strip() for name in given))))
    for name in names:
        if name not in METHODS:
            raise ConfigError(f"unknown method '{name}'{did_you_mean(name, METHODS)}; known: all, {', '.join(METHODS)}")
    if not names:
        raise ConfigError(f"no method was named; known: all, {', '.join(METHODS)}")
    return names


def run_method(
    method: str,
    source: str | os.PathLike[str],
    truth: Truth,
    folder: Path,
    *,
    reference: str | os.PathLike[str] | None = None,
    config: Config,
    backbone: str | None = None,
    model: str | os.PathLike[str] | None = None,
    tolerance: int,
    progress: RunProgress | None = None,
) -> MethodResult:
    """Run one method into `folder` and judge it; see `compare_methods`."""
    report = partial(_named, method, progress) if progress else None
    detect = partial(detect_loops, source, folder, reference=reference, model=model, progress=report)
    note = ""
    try:
        wanted = config_for(method, config, backbone)
        try:
            run = detect(config=wanted)
        except WeightsError as error:
            if not replaceable(wanted):
                raise
            note = f"{error}{_hint(method)}"
            stand_in = wanted.with_settings({"features.backbone": EMBEDDED})
            run = detect(config=stand_in)
    except LoopClosureError as error:
        return MethodResult(method, note=f"{error}{_hint(method) if isinstance(error, WeightsError) else ''}")
    return judge_run(method, folder, run.info, truth, tolerance=tolerance, mark=_mark(method, wanted, run), note=note)


def judge_run(
    method: str, folder: Path, info: Mapping[str, Any], truth: Truth, *, tolerance: int, mark: str, note: str
) -> MethodResult:
    """Judge the run folder of a method and write ``metrics.json`` into it; `info` is its ``run.json``."""
    metrics, curve = evaluate(read_loops(folder), truth, tolerance=tolerance)
    write_whole(folder / METRICS, json.dumps(metrics, indent=2) + "\n")
    return MethodResult(method, metrics, curve, milliseconds_a_frame(info), info, mark, note)


def config_for(method: str, config: Config, backbone: str | None = None) -> Config:
    """Return `config` with what the name of the method says; `backbone` replaces a network that makes maps."""
    own = config.with_settings({"method": method})
    if backbone is None or not _makes_maps(own):
        return own
    layer = config.features.layer if config.features.backbone == backbone else ""
    return own.with_settings({"features.backbone": backbone, "features.layer": layer})


def milliseconds_a_frame(info: Mapping[str, Any], *, map_was_saved: bool = False) -> float:
    """Return the time of the stages that every frame passes, without reading and learning.

    Parameters
    ----------
    info : mapping
        Content of ``run.json``.
    map_was_saved : bool
        Whether the references came from a saved detector, whose features this run did not compute.
    """
    seconds, frames = info["seconds"], info["frames"]
    described = frames if map_was_saved else frames + (info["references"] or 0)
    return 1000 * (seconds["features"] / described + (seconds["describe"] + seconds["match"]) / frames)


def _frames(
    source: str | os.PathLike[str], reference: str | os.PathLike[str] | None, config: Config
) -> tuple[int, int | None]:
    """Return how many frames there are of both; a missing image is found before the first method runs."""
    if reference is not None and (Path(reference) / HEADER).is_file():
        raise ConfigError(f"{reference} is the saved detector of one method; give its images to compare several")
    policy = config.images.on_error
    references = None if reference is None else len(ImageSequence(reference, on_error=policy))
    return len(ImageSequence(source, on_error=policy)), references


def _truth(
    path: str | os.PathLike[str], size: tuple[int, int | None], config: Config, settings: Mapping[str, Any] | None
) -> Truth:
    exclude = config.sequence.exclude_recent if size[1] is None else 0
    return load_truth(path, frames=size, exclude_recent=exclude, **(settings or {}))


def _makes_maps(config: Config) -> bool:
    from loopclosure.features.backbones import BACKBONES

    return config.features.backbone in BACKBONES


def replaceable(config: Config) -> bool:
    """Whether the embedded network may stand in: the user did not ask for weights of their own."""
    return config.features.weights == "default" and config.features.backbone != EMBEDDED and _makes_maps(config)


def _hint(method: str) -> str:
    own = METHODS[method].weights
    hint = f"; `loopclosure weights fetch {own}` tries again" if own else ""
    if own and not replaceable(Config(method=method)):
        hint += f", `--weights {method}={RANDOM}` runs it untrained"
    return hint


def _mark(method: str, wanted: Config, run: Run) -> str:
    if not run.info["weights"]:
        return ""
    used = run.info["config"]["features"]
    own = METHOD_SETTINGS.get(method, {}).get("features.backbone", wanted.features.backbone)
    marks = []
    if used["backbone"] != own:
        marks.append("embedded backbone" if used["backbone"] == EMBEDDED else f"backbone {used['backbone']}")
    if used["weights"] == RANDOM:
        marks.append("random weights")
    return ", ".join(marks)


def _named(method: str, progress: RunProgress, stage: str, done: int, total: int) -> None:
    progress(f"{method}: {stage}", done, total)
