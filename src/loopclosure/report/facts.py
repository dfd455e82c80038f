"""What a run says of itself, in words and numbers; the page only sets them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from loopclosure.config import Config
from loopclosure.evaluation.compare import milliseconds_a_frame
from loopclosure.records import Decision, Reason
from loopclosure.report.pairs import Pair
from loopclosure.runs import Run
from loopclosure.weights.table import RANDOM_NAME

REASONS = {
    Reason.ACCEPTED: "the best candidate passed",
    Reason.BELOW_THRESHOLD: "the best candidate is not similar enough",
    Reason.INCONSISTENT: "similar enough, but the frames before do not lead up to it",
    Reason.NOT_VERIFIED: "similar enough, but the geometry of the two images does not agree",
    Reason.SEQUENCE_TOO_SHORT: "fewer frames than one sequence",
    Reason.TOO_RECENT: "every earlier frame is too near",
    Reason.WARMING_UP: "the first frames, collected to learn from",
    Reason.UNREADABLE: "the image could not be decoded",
}
_HASH = 12  # digits of a hash that are shown
_UNITS = {"tolerance": "frames", "exclusion": "frames", "radius_m": "m"}


class Number(NamedTuple):
    """A key number: what it counts, and what it needs to be understood."""

    value: str
    label: str
    note: str = ""


def name_of(source: str) -> str:
    """Return the last part of a path."""
    return Path(source).name or source


def title_of(info: Mapping[str, Any]) -> str:
    """Return the names of the two sequences, or of the one."""
    source, reference = name_of(info["source"]), info["reference"]
    return source if reference is None else f"{source} against {name_of(reference)}"


def summary(run: Run, loops: Sequence[Pair]) -> str:
    """Say in a few sentences what came out."""
    threshold = run.info["threshold"]
    sentences = [f"{_count(len(loops), 'loop')} accepted among {_count(len(run.decisions), 'frame')}"]
    if loops:
        sentences[0] += f", the first at frame {loops[0].query}, the last at frame {loops[-1].query}"
    else:
        scores = [decision.score for decision in run.decisions if decision.score is not None]
        best = f"the best candidate scored {max(scores):.2f}" if scores else "no frame had a candidate"
        sentences[0] += f": {best}, the threshold is {threshold:g}"
    told = [loop for loop in loops if loop.right is not None]
    if told:
        right = sum(loop.right is True for loop in told)
        sentences.append(f"By the truth {right} are right and {len(told) - right} wrong")
    if unreadable := sum(decision.reason is Reason.UNREADABLE for decision in run.decisions):
        sentences.append(f"{_count(unreadable, 'frame')} could not be read")
    return ". ".join(sentences) + "."


def key_numbers(run: Run, loops: Sequence[Pair], metrics: Mapping[str, Any] | None) -> list[Number]:
    """Return the numbers of the head of the page."""
    references = run.info["references"]
    note = "in one stream" if references is None else f"against {references}"
    time = milliseconds_a_frame(run.info, map_was_saved=run.reference_images is None)
    numbers = [
        Number(str(len(run.decisions)), "frames", note),
        Number(str(len(loops)), "accepted loops"),
        Number(f"{time:.1f}", "ms a frame", "features, descriptor, search"),
    ]
    if metrics is not None:
        low_high = metrics["recall_at_100_precision_interval"]
        interval = "" if low_high is None else "95 % interval " + " to ".join(f"{100 * end:.1f}" for end in low_high)
        numbers += [
            Number(percent(metrics["precision"]), "precision", "of the accepted loops"),
            Number(percent(metrics["recall"]), "recall", "of the accepted loops"),
            Number(percent(metrics["recall_at_100_precision"]), "recall at 100 % precision", interval),
        ]
    return numbers


def measured(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the rows of the accuracy table."""
    shares = {
        "Recall at 100 % precision": "recall_at_100_precision",
        "Recall at 99 % precision": "recall_at_99_precision",
        "Recall at 95 % precision": "recall_at_95_precision",
        "Average precision": "average_precision",
        "Best candidate right": "top1",
    }
    return [
        *((label, percent(metrics[name])) for label, name in shares.items()),
        ("Right and wrong loops", f"{metrics['true_positives']} and {metrics['false_positives']}"),
        ("Frames with a true match", f"{metrics['rows_with_truth']} of {metrics['rows']}"),
    ]


def percent(share: float | None) -> str:
    """Write a share in percent; only all is 100.0 %.

    Examples
    --------
    >>> percent(0.5), percent(0.9999), percent(1.0), percent(None)
    ('50.0 %', '99.9 %', '100.0 %', 'undefined')
    """
    if share is None:
        return "undefined"
    return f"{100 * share if share == 1 else min(100 * share, 99.9):.1f} %"


def reason_counts(decisions: Sequence[Decision]) -> list[tuple[str, str, int]]:
    """Return each reason that occurs, what it means and how often, the most frequent first."""
    counts = Counter(decision.reason for decision in decisions)
    return [(str(reason), REASONS[reason], count) for reason, count in counts.most_common()]


def changed_settings(info: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the settings that are not the default."""
    default = Config().flat()
    return [
        (name, f"{_setting(value)} (default {_setting(default[name])})")
        for name, value in Config.from_dict(info["config"]).flat().items()
        if value != default[name]
    ]


def _setting(value: Any) -> str:
    return "not set" if value is None else str(value)


def random_weights(info: Mapping[str, Any]) -> bool:
    """Whether the network was never trained."""
    return info["weights"].get("weights") == RANDOM_NAME


def provenance(info: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return what the result was made with."""
    machine = info["machine"]
    facts = [("Method", info["config"]["method"]), ("Threshold", f"{info['threshold']:g}")]
    facts += [(_words(name), _short(name, value)) for name, value in info["weights"].items()]
    facts += [
        ("Learned on", "; ".join(info["learned_on"]) or "nothing"),
        ("loopclosure", info["loopclosure"]),
        *((package, version) for package, version in info["versions"].items()),
        ("System", machine["system"]),
        ("Processor", f"{machine['processor'] or 'unnamed'}, {_count(machine['cores'], 'core')}"),
    ]
    return facts


def protocol(metrics: Mapping[str, Any]) -> list[tuple[str, str]]:
    """Return the rules under which the accuracy holds."""
    return [(_words(name), _short(name, value)) for name, value in metrics["protocol"].items() if value is not None]


def _words(name: str) -> str:
    words = name.removesuffix("_m").replace("_", " ").replace("sha256", "SHA-256")
    return words[:1].upper() + words[1:]


def _short(name: str, value: Any) -> str:
    if name.endswith(("sha256", "hash")):
        return str(value)[:_HASH]
    return f"{value} {_UNITS[name]}" if name in _UNITS else str(value)


def _count(number: int, noun: str) -> str:
    return f"{number} {noun}" if number == 1 else f"{number} {noun}s"
