"""The report of a run: one page that needs nothing but itself."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jinja2 import Environment, StrictUndefined
from matplotlib.figure import Figure
from PIL import Image

from loopclosure.errors import ImageError
from loopclosure.evaluation.metrics import PrecisionRecall
from loopclosure.evaluation.truth import Truth
from loopclosure.images.sequence import ImageSequence
from loopclosure.report import facts
from loopclosure.report.curves import precision_recall
from loopclosure.report.matrices import similarity_matrix
from loopclosure.report.pairs import Pair, judge, spread
from loopclosure.report.reliability import reliability
from loopclosure.report.style import MARKS, png
from loopclosure.report.trajectory import trajectory
from loopclosure.runs import Run, write_whole

REPORT = "report.html"
_MOST = 8  # pairs that are shown
_WORST = 4  # mistakes that are shown
_THUMBNAIL = (320, 320)  # pixels
_JPEG_QUALITY = 80


def write_report(
    run: Run,
    *,
    metrics: Mapping[str, Any] | None = None,
    curve: PrecisionRecall | None = None,
    truth: Truth | None = None,
    poses: np.ndarray | None = None,
    reference_poses: np.ndarray | None = None,
    title: str | None = None,
) -> Path:
    """Write ``report.html`` into the run folder.

    Parameters
    ----------
    run : Run
        Its images are read again, a few of them.
    metrics : mapping, optional
        Content of ``metrics.json``; its protocol says within how many frames of the truth a match is right.
    curve : PrecisionRecall, optional
        Where truth is known.
    truth : Truth, optional
        For the same frames.
    poses, reference_poses : ndarray of float, shape (frames, 2), optional
        Positions of the frames and of those of the other traverse, metres.
    title : str, optional
        The names of the sequences if absent.

    Returns
    -------
    pathlib.Path
        The page: pictures and style are inside, no script, no request to anywhere.

    Raises
    ------
    TruthError
        If truth or poses are of other frames than the run.
    """
    tolerance = 0 if metrics is None else metrics["protocol"]["tolerance"]
    pairs = judge(run.decisions, truth, tolerance=tolerance)
    loops = [pair for pair in pairs if pair.accepted]
    matrix = similarity_matrix(run.matrix, frames=_frames(run), truth=truth, loops=loops)
    reliable = reliability(pairs) if run.info.get("calibrated") else None
    path = trajectory(poses, loops, truth, reference_xy_m=reference_poses) if poses is not None else None
    page = _template().render(
        title=title or facts.title_of(run.info),
        info=run.info,
        random_weights=facts.random_weights(run.info),
        summary=facts.summary(run, loops),
        numbers=facts.key_numbers(run, loops, metrics),
        matrix=_embed(matrix),
        loops=loops,
        best=_cards(run, loops or pairs, truth, most=_MOST),
        mistakes=_cards(run, [pair for pair in pairs if pair.right is False], truth, most=_WORST),
        judged=truth is not None,
        curve=_embed(precision_recall({run.info["config"]["method"]: curve})) if curve is not None else None,
        reliability=_embed(reliable) if reliable is not None else None,
        measured=facts.measured(metrics) if metrics is not None else [],
        protocol=facts.protocol(metrics) if metrics is not None else [],
        trajectory=_embed(path) if path is not None else None,
        reasons=facts.reason_counts(run.decisions),
        seconds=[(stage, f"{seconds:.2f}") for stage, seconds in run.info["seconds"].items()],
        settings=facts.changed_settings(run.info),
        provenance=facts.provenance(run.info),
    )
    file = run.folder / REPORT
    write_whole(file, page.encode("utf-8", "replace").decode("utf-8"))  # a file name may hold what is no text
    return file


class _Card(NamedTuple):
    """A pair as the page shows it."""

    pair: Pair
    sign: str
    verdict: str
    query_name: str
    match_name: str
    query_image: str | None
    match_image: str | None
    true_matches: str


def _cards(run: Run, pairs: list[Pair], truth: Truth | None, *, most: int) -> list[_Card]:
    """Choose pairs spread over the drive, not ten neighbours of one loop."""
    apart = max(1, len(run.decisions) // (2 * most))
    return [_card(run, pair, truth) for pair in spread(pairs, most, apart=apart)]


def _card(run: Run, pair: Pair, truth: Truth | None) -> _Card:
    verdict = "" if pair.right is None else MARKS[pair.right].label
    return _Card(
        pair,
        MARKS[pair.right].sign,
        verdict if pair.accepted else f"{verdict}, not accepted".lstrip(", "),
        run.query_images.names[pair.query],
        "" if run.reference_images is None else run.reference_images.names[pair.match],
        _thumbnail(run.query_images, pair.query),
        _thumbnail(run.reference_images, pair.match),
        _true_matches(truth, pair.query),
    )


def _true_matches(truth: Truth | None, query: int) -> str:
    if truth is None:
        return ""
    matches = np.sort(truth.pairs[[query]].nonzero()[1])
    if not len(matches):
        return "the truth has no match for this frame"
    if len(matches) == 1:
        return f"true match: frame {matches[0]}"
    return f"true matches: {len(matches)} from frame {matches[0]} to {matches[-1]}"


def _frames(run: Run) -> tuple[int, int]:
    frames = len(run.decisions)
    return frames, run.info["references"] or frames


def _thumbnail(images: ImageSequence | None, position: int) -> str | None:
    """Return a small JPEG as a data URI; None where there is no image any more."""
    try:
        pixels = None if images is None else images[position]
    except ImageError:
        return None
    if pixels is None:
        return None
    picture = Image.fromarray(pixels)
    picture.thumbnail(_THUMBNAIL)
    stream = io.BytesIO()
    picture.save(stream, "jpeg", quality=_JPEG_QUALITY)
    return _data_uri("jpeg", stream.getvalue())


def _embed(figure: Figure) -> str:
    return _data_uri("png", png(figure))


def _data_uri(kind: str, content: bytes) -> str:
    return f"data:image/{kind};base64,{base64.b64encode(content).decode('ascii')}"


def _template() -> Any:
    text = resources.files(__package__).joinpath(REPORT).read_text(encoding="utf-8")
    return Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True).from_string(
        text
    )
