"""How fast this machine is: each stage, against plain torchvision, against its own matrix multiplication.

Times of a machine that does other work too mean little. All that is compared takes turns in one process, and a ratio
is the median of the ratios of the rounds.
"""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import cycle, islice
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from loopclosure.config import Config
from loopclosure.detect import LoopDetector
from loopclosure.errors import ConfigError, ImageError, LoopClosureError, WeightsError
from loopclosure.evaluation.machine import describe_machine
from loopclosure.evaluation.paper import METHODS, OURS
from loopclosure.images.decode import read_image
from loopclosure.images.sequence import ImageSequence
from loopclosure.methods.kl_netvlad import KLNetVLAD
from loopclosure.weights import RANDOM, is_cached, weights_for

if TYPE_CHECKING:
    from loopclosure.features.backbones import Backbone

PLACES = 1000
"""Places of the map in which the stage `search` looks."""

_BATCH = 8
_MATRIX = 2048  # rows and columns of the matrices that are multiplied
_CAMERA = (640, 480)  # pixels of the simulated images
_FIT_FRAMES = 32
Progress = Callable[[str, int, int], None]


@dataclass(frozen=True)
class Contest:
    """Times of things that took turns.

    Attributes
    ----------
    milliseconds : dict of str to list of float
        By name, one a round.
    """

    milliseconds: dict[str, list[float]]

    def median(self, name: str) -> float:
        """Return the usual time of one of them."""
        return float(np.median(self.milliseconds[name]))

    def ratio(self, slow: str, fast: str) -> float:
        """Return how many times as long `slow` takes, the median over rounds."""
        return float(np.median(np.divide(self.milliseconds[slow], self.milliseconds[fast])))


def take_turns(
    tasks: Mapping[str, Callable[[], Any]], rounds: int, *, each: int = 1, progress: Callable[[int], None] | None = None
) -> Contest:
    """Time tasks in turn, after one round that does not count.

    Parameters
    ----------
    tasks : dict of str to callable
        What to do.
    rounds : int
        How often each is timed.
    each : int
        Images that a task goes through; times are those of one.
    """
    times: dict[str, list[float]] = {name: [] for name in tasks}
    for done in range(rounds + 1):
        for name, task in tasks.items():
            start = time.perf_counter()
            task()
            times[name].append(1000 * (time.perf_counter() - start) / each)
        if progress:
            progress(done)
    return Contest({name: values[1:] for name, values in times.items()})


def measure_speed(
    config: Config | None = None,
    *,
    images: str | os.PathLike[str] | None = None,
    frames: int = 16,
    rounds: int = 5,
    table7: bool = False,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Measure the method `kl-netvlad` from image files to decisions.

    Parameters
    ----------
    config : Config, optional
        Which network, layer, compression and so on. Where its weights are not on this machine random ones are taken,
        which are as fast, and the result says so.
    images : path, optional
        Folder of images, text file of paths; a simulated drive, 640 x 480 pixels, if there is none.
    frames : int
        Images of one round.
    rounds : int
        How often everything is measured.
    table7 : bool
        Also measure the methods of the paper's Table 7.
    progress : callable, optional
        ``progress(stage, done, total)``.

    Returns
    -------
    dict
        What ``loopclosure bench --json`` prints.

    Raises
    ------
    ConfigError
        For another method.
    """
    report = progress or (lambda *_: None)
    config = _with_weights(config or Config())
    if config.method != "kl-netvlad":
        raise ConfigError(f"bench measures the stages of kl-netvlad, found method = {config.method}; see --table7")
    with _files(images, max(frames, _FIT_FRAMES), report) as files, tempfile.TemporaryDirectory() as folder:
        measured = _measure(config, files, frames, rounds, Path(folder), report)
        if table7:
            measured["table7"] = _table7(config, files, frames, rounds, Path(folder), report)
    return measured


def _measure(
    config: Config, files: Sequence[Path], frames: int, rounds: int, folder: Path, report: Progress
) -> dict[str, Any]:
    from loopclosure.evaluation.eager import EagerPipeline

    source = _listed(files[:frames], folder)
    detector = LoopDetector(config)
    detector.fit(_listed(files, folder), source="benchmark")
    detector.set_reference(source)  # every frame is a loop, with one right place: the most that a decision can cost
    method = cast(KLNetVLAD, detector.method)
    eager = EagerPipeline(config, files[:frames])
    tasks = {
        "throughput": lambda: _drain(detector.detect(source)),
        "latency": lambda: [detector.add(read_image(file, at_least=method.input_size)) for file in files[:frames]],
        "eager": lambda: [eager(file) for file in files[:frames]],
    }
    before = dict(detector.seconds)
    whole = take_turns(tasks, rounds, each=frames, progress=lambda done: report("pipelines", done, rounds))
    stages = _stages(method, files, rounds, report) | {
        stage: round(1000 * (detector.seconds[stage] - before[stage]) / detector.frames, 3)
        for stage in ("picture", "decide")
    }
    network = cast("Backbone", method.backbone)
    openvino = hasattr(network, "precision")
    precision = getattr(network, "precision", "f32")
    multiply, flop = _multiplication(precision, openvino=openvino)
    batch = network.preprocessing.batch([read_image(file) for file in files[:_BATCH]])
    share = take_turns({"backbone": lambda: network.compute(batch), "multiply": multiply}, 2 * rounds)
    limit = flop / share.median("multiply") * 1e3
    needed = _BATCH * eager.flop
    return {
        "machine": describe_machine(),
        "load_average": round(os.getloadavg()[0], 2) if hasattr(os, "getloadavg") else None,
        "network": f"{config.features.backbone} {config.features.layer}",
        "weights": network.weights_name,
        "runtime": "openvino" if openvino else "torch",
        "precision": precision,
        "image": "x".join(map(str, read_image(files[0]).shape[1::-1])),
        "rounds": rounds,
        "stages_ms": stages,
        "pipelines_ms": {name: round(whole.median(name), 3) for name in tasks},
        "times_faster_than_eager": {name: round(whole.ratio("eager", name), 2) for name in ("throughput", "latency")},
        "gflop_an_image": round(eager.flop / 1e9, 2),
        "matmul_gflops": round(limit / 1e9, 1),
        "share_of_matmul_limit": round(needed / flop * share.ratio("multiply", "backbone"), 3),
    }


def _stages(method: KLNetVLAD, files: Sequence[Path], rounds: int, report: Progress) -> dict[str, float]:
    """Return the milliseconds of each stage for one image alone, as far as a stage does not depend on the drive."""
    paths = cycle(files)
    prepare = method.backbone.preprocessing
    image = read_image(files[0], at_least=method.input_size)
    batch = prepare.batch([image])
    network = cast("Backbone", method.backbone)
    maps = np.stack(method.features([image]))
    code = method.compress(maps)
    descriptor = method.describe(list(maps))
    kept = method.reduce(descriptor)
    places = method.new_map(exclude_recent=0)
    for _ in range(PLACES):
        places.add(kept)
    tasks = {
        "decode": lambda: read_image(next(paths), at_least=method.input_size),
        "resize": lambda: prepare.batch([image]),
        "backbone": lambda: network.compute(batch),
        "kl": lambda: method.compress(maps),
        "netvlad": lambda: method.aggregate(code),
        "reduce": lambda: method.reduce(descriptor),
        f"search in {PLACES}": lambda: places.similarities(kept),
    }
    contest = take_turns(tasks, 6 * rounds, progress=lambda done: report("stages", done, 6 * rounds))
    return {name: round(contest.median(name), 3) for name in tasks}


def _multiplication(precision: str, *, openvino: bool) -> tuple[Callable[[], Any], float]:
    """Return what multiplies matrices in a precision as fast as this machine can, and its operations."""
    rng = np.random.default_rng(0)
    left, right = (rng.standard_normal((_MATRIX, _MATRIX), dtype=np.float32) for _ in range(2))
    flop = 2.0 * _MATRIX**3
    if not openvino:
        import torch

        a, b = torch.from_numpy(left), torch.from_numpy(right)
        return lambda: a @ b, flop
    from loopclosure.features.openvino_runtime import compile_for_cpu, import_openvino

    ov = import_openvino()
    x = ov.opset13.parameter(left.shape, ov.Type.f32)
    graph = ov.Model([ov.opset13.matmul(x, ov.opset13.constant(right), False, True)], [x])
    request = compile_for_cpu(ov.Core(), graph, precision).create_infer_request()
    request.set_input_tensor(ov.Tensor(left))
    return request.infer, flop


def _table7(
    config: Config, files: Sequence[Path], frames: int, rounds: int, folder: Path, report: Progress
) -> list[dict[str, Any]]:
    """Measure the paper's Table 7: from image file to decision, by the rows of the paper."""
    source, methods, rows = _listed(files[:frames], folder), {"kl-netvlad": OURS, **METHODS}, []
    tasks: dict[str, Callable[[], Any]] = {}
    for done, (name, paper) in enumerate(methods.items()):
        report("preparing the methods", done, len(methods))
        row: dict[str, Any] = {"method": name, "title": paper.title, "paper_ms": paper.milliseconds}
        rows.append(row)
        settings = {"method": name} | ({"features.backbone": "resnet152"} if name == "kl-netvlad" else {})
        try:
            own = _with_weights(config.with_settings({"features.weights": "default", **settings}))
            detector = LoopDetector(own)
            if not detector.method.fitted:
                detector.fit(_listed(files, folder), source="benchmark")
        except LoopClosureError as error:
            row["note"] = str(error)
            continue
        row["weights"] = detector.method.provenance.get("weights")
        tasks[name] = _detecting(detector, source)
    contest = take_turns(tasks, rounds, each=frames, progress=lambda done: report("Table 7", done, rounds))
    for row in rows:
        row["ms"] = round(contest.median(row["method"]), 2) if row["method"] in tasks else None
    return rows


def _detecting(detector: LoopDetector, source: ImageSequence) -> Callable[[], None]:
    return lambda: _drain(detector.detect(source))


def _with_weights(config: Config) -> Config:
    """Take random weights where those that are wanted are not on this machine."""
    try:
        here = config.features.weights == RANDOM or is_cached(
            weights_for(config.features.backbone, config.features.weights)
        )
    except WeightsError:
        return config  # the method says what is wrong with them
    return config if here else config.with_settings({"features.weights": RANDOM})


@contextmanager
def _files(images: str | os.PathLike[str] | None, count: int, report: Progress) -> Iterator[list[Path]]:
    """Give `count` image files: those of a folder or list over and over, or a simulated drive."""
    with tempfile.TemporaryDirectory() as folder:
        if images is None:
            from loopclosure.images.simulator import SimulationSettings, simulate

            settings = SimulationSettings(frames=count, width=_CAMERA[0], height=_CAMERA[1], revisit=False)
            simulate(Path(folder) / "drive", settings, progress=lambda done, total: report("rendering", done, total))
            images = Path(folder) / "drive" / "images"
        sequence = ImageSequence(images)
        if sequence.is_video:
            raise ImageError(f"{images} is a video, wanted image files: decoding them is measured too")
        parent = Path(images) if Path(images).is_dir() else Path(images).parent
        yield [(parent / name).resolve() for name in islice(cycle(sequence.names), count)]


def _listed(files: Sequence[Path], folder: Path) -> ImageSequence:
    """Return files as a sequence."""
    path = folder / f"{len(files)}.txt"
    path.write_text("\n".join(map(str, files)) + "\n", encoding="utf-8")
    return ImageSequence(path)


def _drain(decisions: Iterator[Any]) -> None:
    for _ in decisions:
        pass
