"""Why two frames were alike: heat maps, matches, clusters and the KL spectrum, as pictures and one page."""

from __future__ import annotations

import base64
import json
import os
from collections.abc import Mapping, Sequence
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure

from loopclosure import __version__
from loopclosure.config import Config
from loopclosure.detect import LoopDetector
from loopclosure.errors import FitError, ImageError, ResultsError
from loopclosure.evaluation.log import LOOPS_FILE, read_loops
from loopclosure.images.decode import read_image
from loopclosure.images.sequence import ImageSequence
from loopclosure.perception import Frames
from loopclosure.report.heatmaps import Explainer, View, check_explainable, cosine, matches
from loopclosure.report.means import means_taken_out, window_start
from loopclosure.report.overlays import draw_clusters, draw_heat
from loopclosure.report.pairs import Pair, spread
from loopclosure.report.spectrum import kl_spectrum
from loopclosure.report.style import png
from loopclosure.report.verification import draw_verification
from loopclosure.runs import MODEL, RUN, RunProgress, write_whole
from loopclosure.store import HEADER
from loopclosure.verification import Verifier

PAGE = "explain.html"
MAX_INFO_BYTES = 1 << 26
_POSITIONS_A_CLUSTER = 16  # where the images themselves are all that there is to learn clusters from


class Explanation(NamedTuple):
    """What was written: the page, which holds all pictures, and the pictures as files of their own."""

    page: Path
    pictures: tuple[Path, ...]


class _Plate(NamedTuple):
    """A picture of the page: its file, its heading and what to say of it."""

    file: Path
    title: str
    text: str
    picture: str


def explain_run(
    run: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    query: int | None = None,
    most: int = 4,
    progress: RunProgress | None = None,
) -> Explanation:
    """Show on the images of a run which positions made its loops.

    The descriptors are made again, with what the run had learned by its end. The mean that was taken out of each is
    computed from the frames that it came from; only that of the first 19 frames of one stream is near to, not equal
    to, what the run used, because the frames that stood in for those before them are no longer known.

    Parameters
    ----------
    run : path
        Run folder.
    out : path
        Folder for the pictures and ``explain.html``; made if it is absent.
    query : int, optional
        Frame whose best candidate is explained, accepted or not; the best loops of the run if absent.
    most : int
        So many loops at most, spread over the drive.
    progress : callable, optional
        ``progress(stage, done, total)``.

    Returns
    -------
    Explanation

    Raises
    ------
    ResultsError
        If the folder holds no run, or no pair that can be explained.
    LoopClosureError
        If the method has no heat maps, or the images, the weights or the model of the run cannot be used.
    """
    folder = Path(run)
    info = _read_info(folder)
    check_explainable(Config.from_dict(info["config"]))
    pairs = _chosen(folder, query, most)
    detector = LoopDetector(model=folder / MODEL)
    queries, references = _images(info, detector.config)
    explainer = Explainer(detector.method)
    report = progress or (lambda *_: None)
    means = means_taken_out(detector, pairs, queries, references, lambda *count: report("mean of the drive", *count))
    plates: list[_Plate] = []
    for number, pair in enumerate(pairs):
        window = detector.method.window
        left, right = (
            explainer.look(_frame(images, frame), mean[frame], before=images[window_start(images, frame, window)])
            for images, frame, mean in ((queries, pair.query, means[0]), (references or queries, pair.match, means[1]))
        )
        names = (f"query {pair.query}", f"match {pair.match}")
        said = f"Score {pair.score:.3f}, {'accepted' if pair.accepted else 'not accepted'}. "
        plates += _draw(Path(out), explainer, (left, right), names, said, f"{pair.query:06}_{pair.match:06}")
        report("heat maps", number + 1, len(pairs))
    centred = "The running mean of the drive is taken out" if detector.config.aggregation.centre_window else _NO_MEAN
    return _write(Path(out), folder.resolve().name, detector, plates, centred)


def explain_images(
    images: Sequence[str | os.PathLike[str]],
    out: str | os.PathLike[str],
    *,
    config: Config | None = None,
    model: str | os.PathLike[str] | None = None,
) -> Explanation:
    """Show what makes two images similar, or what the descriptor of one image is made of.

    Parameters
    ----------
    images : sequence of one or two paths
        Image files.
    out : path
        As for `explain_run`.
    config, model
        As for `LoopDetector`. Without a model, basis and clusters are learned on the images themselves, with fewer
        clusters than are set where the images are too small for them.

    Returns
    -------
    Explanation

    Raises
    ------
    LoopClosureError
        If an image, a setting, the weights or the model cannot be used.
    """
    if len(images) not in (1, 2):
        raise ImageError(f"{len(images)} images given, wanted one or two")
    check_explainable(config or Config())
    detector = LoopDetector(config, model=model)
    pixels = [read_image(image, max_megapixels=detector.config.images.max_megapixels) for image in images]
    if model is None:
        detector = _learned_on(pixels, detector)
    explainer = Explainer(detector.method)
    views = [explainer.look(image) for image in pixels]
    names = [Path(image).name for image in images]
    plates = _draw(Path(out), explainer, views, names, "", "images")
    return _write(Path(out), " and ".join(names), detector, plates, _NO_MEAN)


_NO_MEAN = "No mean is taken out"


def _learned_on(pixels: list[np.ndarray], detector: LoopDetector) -> LoopDetector:
    """Fit on one or two images, which hold few local vectors, and too few descriptors to whiten any."""
    positions = sum(maps[..., 0].size for maps in detector.method.features(pixels))
    clusters = min(detector.config.aggregation.clusters, max(1, positions // _POSITIONS_A_CLUSTER))
    settings = {"aggregation.clusters": clusters, "aggregation.components": 0}
    detector = LoopDetector(detector.config.with_settings(settings))
    try:
        detector.fit(pixels, source="images shown")
    except FitError as error:
        raise FitError(f"{error} (learned on the images shown; a model of `loopclosure fit` knows more)") from None
    return detector


def _read_info(folder: Path) -> dict[str, Any]:
    file = folder / RUN
    if not file.is_file():
        raise ResultsError(f"{folder} holds no {RUN}: it is not the folder of a run")
    try:
        if file.stat().st_size > MAX_INFO_BYTES:
            raise ResultsError(f"{file} is larger than {MAX_INFO_BYTES} bytes: it is not ours")
        info = json.loads(file.read_text(encoding="utf-8"))
        if isinstance(info["config"], dict) and isinstance(info["source"], str):
            return {"reference": None, "references": None} | info
    except (ValueError, RecursionError, TypeError, KeyError, OSError):
        pass
    raise ResultsError(f"{file} is damaged: wanted a JSON object with config and source")


def _chosen(folder: Path, query: int | None, most: int) -> list[Pair]:
    """Return the pairs to show, in the order of the drive."""
    log = read_loops(folder)
    frames = len(log)
    pairs = [
        Pair(int(i), int(log.match[i]), float(log.score[i]), bool(log.accepted[i]))
        for i in np.flatnonzero(log.match >= 0)
    ]
    if query is not None:
        found = [pair for pair in pairs if pair.query == query]
        if not found:
            said = f"reason {log.reason[query]}" if 0 <= query < frames else f"the run has {frames} frames"
            raise ResultsError(f"frame {query} of {folder / LOOPS_FILE} has no candidate: {said}")
        return found
    loops = [pair for pair in pairs if pair.accepted] or pairs
    if not loops:
        raise ResultsError(f"no frame of {folder / LOOPS_FILE} has a candidate: there is no pair to explain")
    return sorted(spread(loops, most, apart=max(1, frames // (2 * most))))


def _images(info: Mapping[str, Any], config: Config) -> tuple[ImageSequence, ImageSequence | None]:
    """Return the images of the queries, and those of the references unless the run is one stream."""

    def opened(source: str) -> ImageSequence:
        return ImageSequence(source, on_error=config.images.on_error, max_megapixels=config.images.max_megapixels)

    queries = opened(info["source"])
    if info["reference"] is None:
        return queries, None
    if (Path(info["reference"]) / HEADER).is_file():
        raise ResultsError(f"the references of the run are the saved detector {info['reference']}: no images to show")
    return queries, opened(info["reference"])


def _frame(images: Frames, position: int) -> np.ndarray:
    image = images[position] if position < len(images) else None
    if image is None:
        raise ImageError(f"frame {position} of the run is no longer there or cannot be read")
    return image


def _draw(
    out: Path, explainer: Explainer, views: Sequence[View], names: Sequence[str], said: str, suffix: str
) -> list[_Plate]:
    """Draw one image or a pair: heat maps with matches, local features that agree with one motion, and clusters."""
    first, last = views[0], views[-1]
    heats = [explainer.heat(view, other) for view, other in zip(views, reversed(views), strict=True)]
    title, text = names[0], f"{said}The heat is what each position adds to the descriptor."
    pairs = []
    if len(views) > 1:
        pairs = matches(first, last)
        title = " and ".join(names)
        alike = cosine(first, last)
        text = f"{said}The two frames alone, unwhitened: {(1 + alike) / 2:.3f}, from a cosine of {alike:.3f}."
    plates = [_plate(out, f"heat_{suffix}.png", title, text, draw_heat(views, heats, names, pairs))]
    if len(views) > 1:
        plates.append(_plate(out, f"geometry_{suffix}.png", "", "", _geometry(first.image, last.image, names)))
    return [*plates, _plate(out, f"clusters_{suffix}.png", "", "", draw_clusters(views, names))]


def _geometry(query: np.ndarray, match: np.ndarray, names: Sequence[str]) -> Figure:
    verifier = Verifier("strict")
    found = verifier.verify(verifier.features(query), verifier.features(match))
    return draw_verification(query, match, found, (names[0], names[-1]))


def _plate(out: Path, file: str, title: str, text: str, figure: Figure) -> _Plate:
    out.mkdir(parents=True, exist_ok=True)
    content = png(figure)
    (out / file).write_bytes(content)
    return _Plate(out / file, title, text, f"data:image/png;base64,{base64.b64encode(content).decode('ascii')}")


def _write(out: Path, title: str, detector: LoopDetector, plates: list[_Plate], centred: str) -> Explanation:
    arrays, spectrum = detector.method.to_arrays(), None
    learned = next((name for name in ("kl.{}", "reduction.{}0") if name.format("energies") in arrays), None)
    if learned is not None:
        figure = kl_spectrum(arrays[learned.format("energies")], kept=len(arrays[learned.format("basis")]))
        spectrum = _plate(out, "spectrum.png", "KL spectrum", "", figure)
    text = resources.files(__package__).joinpath(PAGE).read_text(encoding="utf-8")
    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    page = environment.from_string(text).render(
        title=title,
        plates=plates,
        spectrum=spectrum,
        random_weights=str(detector.method.provenance.get("weights", "")).startswith("random"),
        facts=[
            ("Method", detector.config.method),
            ("Features", f"{detector.config.features.backbone}, {detector.config.features.layer}"),
            ("Clusters", str(detector.config.aggregation.clusters)),
            ("Learned on", "; ".join(detector.learned_on)),
            ("Centring", centred),
        ],
        version=__version__,
    )
    file = out / PAGE
    write_whole(file, page.encode("utf-8", "replace").decode("utf-8"))  # a file name may hold what is no text
    return Explanation(file, tuple(plate.file for plate in [*plates, *([spectrum] if spectrum else [])]))
