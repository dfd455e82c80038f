"""Several methods side by side: one table, as CSV and as a page."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from loopclosure import __version__
from loopclosure.evaluation.compare import Comparison, MethodResult
from loopclosure.report.curves import precision_recall
from loopclosure.report.facts import name_of, percent
from loopclosure.report.html import embed, render
from loopclosure.report.style import png
from loopclosure.runs import write_whole

TABLE, PAGE = "compare.csv", "compare.html"
MEASURES = (
    "recall_at_100_precision",
    "recall_at_99_precision",
    "recall_at_95_precision",
    "average_precision",
    "top1",
    "precision",
    "recall",
)
"""Of ``metrics.json``, the columns of the table."""
HEADS = ("R@100P", "R@99P", "R@95P", "AP", "top-1", "precision", "recall", "ms")
"""Their short names, and that of the time."""


class Cell(NamedTuple):
    """A number as it is shown."""

    text: str
    best: bool = False
    under: str = ""


class Row(NamedTuple):
    """A method as it is shown; no cells if it could not run."""

    method: str
    network: str
    marks: list[str]
    cells: list[Cell]
    note: str


def write_comparison(comparison: Comparison, out: Path) -> Path:
    """Write ``compare.csv`` and ``compare.html`` into the folder `out`; return the page."""
    write_csv(out / TABLE, map(record, comparison.results), more=csv_facts(comparison.protocol, comparison.machine))
    rows = shown_rows(comparison.results)
    curves = {result.method: result.curve for result in comparison.results if result.curve is not None}
    page = render(
        "comparison.html",
        title=title_of(comparison),
        lead=summary(comparison),
        rows=rows,
        protocol=protocol_line(comparison.protocol),
        machine=comparison.machine,
        stand_ins=[row for row in rows if row.cells and row.note],
        curve=embed(png(precision_recall(curves))) if curves else None,
        facts=_facts(comparison),
        version=__version__,
    )
    write_whole(out / PAGE, page)
    return out / PAGE


def title_of(comparison: Comparison) -> str:
    """Return the names of the two sequences, or of the one."""
    source = name_of(comparison.source)
    return f"{source} against {name_of(comparison.reference)}" if comparison.reference else source


def summary(comparison: Comparison) -> str:
    """Say in a sentence or two how much was compared, and who came first."""
    ran = [result for result in comparison.results if result.metrics]
    against = f" against {comparison.references}" if comparison.references else ""
    text = f"{len(ran)} of {len(comparison.results)} methods ran on {comparison.frames} frames{against}."
    best = max((r for r in ran if ranks(r)), key=lambda r: _value(r, "recall_at_100_precision"), default=None)
    if best is None or best.metrics is None or not best.metrics["recall_at_100_precision"]:
        return text
    return f"{text} Most loops without a mistake: {best.method}, {percent(best.metrics['recall_at_100_precision'])}."


def shown_rows(results: Sequence[MethodResult]) -> list[Row]:
    """Return the rows of the table, with the best of each column marked."""
    ran = [result for result in results if result.metrics and ranks(result)]
    best = {name: max((_value(result, name) for result in ran), default=None) for name in MEASURES}
    return [
        Row(
            result.method,
            result.network,
            result.mark.split(", ") if result.mark else [],
            _cells(result, best),
            result.note,
        )
        for result in results
    ]


def ranks(result: MethodResult) -> bool:
    """Whether a result can be the best: an untrained network is not in the race."""
    return "random" not in result.mark


def record(result: MethodResult) -> dict[str, Any]:
    """Return a result as a row of numbers."""
    metrics: Mapping[str, Any] = result.metrics or {}
    low, high = metrics.get("recall_at_100_precision_interval") or (None, None)
    return {
        "method": result.method,
        **{name: metrics.get(name) for name in MEASURES},
        "recall_at_100_precision_low": low,
        "recall_at_100_precision_high": high,
        "threshold": result.info.get("threshold"),
        "accepted": metrics.get("accepted"),
        "rows_with_truth": metrics.get("rows_with_truth"),
        "ms_an_image": None if result.milliseconds is None else round(result.milliseconds, 3),
        "weights": result.network,
        "mark": result.mark,
        "learned_on": "; ".join(result.info.get("learned_on", ())),
        "note": result.note,
    }


def csv_facts(protocol: Mapping[str, Any], machine: str) -> dict[str, Any]:
    """Return what makes a row of a table speak for itself."""
    return {**protocol, "machine": machine, "loopclosure": __version__}


def write_csv(path: Path, rows: Iterable[Mapping[str, Any]], *, more: Mapping[str, Any]) -> None:
    """Write rows with the same keys, and `more` at the end of each; what is None stays empty."""
    text = io.StringIO(newline="")
    full = [{**row, **more} for row in rows]
    writer = csv.DictWriter(text, list(full[0]) if full else list(more), lineterminator="\n")
    writer.writeheader()
    writer.writerows(full)
    write_whole(path, text.getvalue())


def protocol_line(protocol: Mapping[str, Any]) -> str:
    """Say in one line under which rules numbers hold."""
    if not protocol:
        return "nothing ran"
    parts = [
        f"{protocol['level']} level, {protocol['scored']}",
        f"tolerance {protocol['tolerance']} frames",
        f"{protocol['mode']}, frames nearer than {protocol['exclusion']} are no pairs"
        if protocol["exclusion"]
        else protocol["mode"],
        f"view {protocol['view']}",
        f"truth {protocol['truth_form']} {str(protocol['truth_hash'])[:12]}",
    ]
    if protocol["radius_m"] is not None:
        parts.append(f"radius {protocol['radius_m']:g} m")
    return "; ".join(parts)


def _cells(result: MethodResult, best: Mapping[str, float | None]) -> list[Cell]:
    if result.metrics is None or result.milliseconds is None:
        return []
    cells = []
    for name in MEASURES:
        value = result.metrics[name]
        wins = bool(value) and ranks(result) and value == best[name]
        cells.append(Cell(percent(value).removesuffix(" %"), wins, _interval(result.metrics, name)))
    return [*cells, Cell(f"{result.milliseconds:.1f}")]


def _interval(metrics: Mapping[str, Any], name: str) -> str:
    interval = metrics.get(f"{name}_interval")
    return "" if interval is None else " to ".join(f"{100 * end:.0f}" for end in interval)


def _value(result: MethodResult, name: str) -> float:
    value = None if result.metrics is None else result.metrics[name]
    return -1.0 if value is None else float(value)


def _facts(comparison: Comparison) -> list[tuple[str, str]]:
    facts = [("Images", comparison.source)]
    if comparison.reference:
        facts.append(("Reference", comparison.reference))
    facts += [("Truth SHA-256", str(comparison.protocol.get("truth_hash", ""))), ("Machine", comparison.machine)]
    for result in comparison.results:
        if result.info:
            sha256 = str(result.info["weights"].get("weights_sha256") or "")[:12]
            weights = f"{result.network} {sha256}".strip() or "no network"
            learned = "; ".join(result.info["learned_on"]) or "nothing"
            facts.append((result.method, f"{weights}; learned on {learned}; threshold {result.info['threshold']:g}"))
    return facts
