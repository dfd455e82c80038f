"""The paper's experiments as one page, tables as CSV and pictures as PNG."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, NamedTuple

from matplotlib.figure import Figure

from loopclosure import __version__
from loopclosure.evaluation import paper
from loopclosure.evaluation.compare import MethodResult
from loopclosure.evaluation.experiments import Experiment, GridResult, Reproduction
from loopclosure.methods import METHODS
from loopclosure.report import experiment_figures as figures
from loopclosure.report.comparison import MEASURES, csv_facts, protocol_line, ranks, record, write_csv
from loopclosure.report.curves import precision_recall
from loopclosure.report.facts import percent
from loopclosure.report.html import PIXELS_PER_INCH, embed, render
from loopclosure.report.style import png
from loopclosure.runs import write_whole

PAGE, TABLES, FIGURES = "reproduce.html", "tables", "figures"
_HEAD = "recall_at_100_precision"
_DASH = "–"


class Cell(NamedTuple):
    """A number as it is shown."""

    text: str
    best: bool = False
    under: str = ""
    paper: bool = False


class LayerRow(NamedTuple):
    """A layer, at all ratios."""

    name: str
    size: str
    cells: list[Cell]


class MethodRow(NamedTuple):
    """A method, or the paper's own at one ratio; no cells if it could not run."""

    name: str
    network: str
    marks: list[str]
    cells: list[Cell]
    note: str
    paper_recall: str
    paper_time: str
    last_of_grid: bool = False


def write_experiments(result: Reproduction, out: Path) -> Path:
    """Write ``reproduce.html``, ``tables/*.csv`` and ``figures/*.png`` into the folder `out`; return the page."""
    for folder in (TABLES, FIGURES):
        (out / folder).mkdir(parents=True, exist_ok=True)
    for experiment in result.experiments:
        _write_tables(result, experiment, out / TABLES)
    names = paper.SETS.get(result.name, paper.ANY_SET)
    page = render(
        "experiments.html",
        title=names.title or result.name,
        lead=_lead(result),
        warnings=list(_warnings(result)),
        random=result.random,
        names=names,
        ratios=[figures.ratio_name(gamma) for gamma in (None, *paper.GAMMAS)],
        parts=[_part(result, experiment, names, out / FIGURES) for experiment in result.experiments],
        machine=result.machine,
        facts=_facts(result),
        version=__version__,
    )
    write_whole(out / PAGE, page)
    return out / PAGE


def recall_rows(experiment: Experiment, measure: str = _HEAD) -> list[LayerRow]:
    """Return Table 4 or 5, or the same by another measure."""
    best = max((value for r in experiment.grid if (value := r.metrics[measure]) is not None), default=None)
    rows = []
    for layer in dict.fromkeys(result.cell.layer for result in experiment.grid):
        results = [result for result in experiment.grid if result.cell.layer == layer]
        kept = ", ".join(str(result.cell.components) for result in results)
        cells = [_grid_cell(result, measure, best) for result in results]
        rows.append(LayerRow(layer, f"{kept} channels", cells))
    return rows


def _grid_cell(result: GridResult, measure: str, best: float | None) -> Cell:
    value = result.metrics[measure]
    below = f"paper {_DASH if result.paper is None else f'{result.paper:.2f}'}"
    return Cell(_share(value), bool(value) and value == best, below)


def method_rows(result: Reproduction, experiment: Experiment) -> list[MethodRow]:
    """Return Tables 6 and 7 in one."""
    chosen = _table_6(result, experiment)
    runs = {method.method: method for method in experiment.methods}
    metrics = [cell.metrics for cell in chosen if not result.random]
    metrics += [run.metrics for run in runs.values() if run.metrics and ranks(run)]
    best = {name: max((m[name] for m in metrics if m[name] is not None), default=None) for name in MEASURES}
    rows = [_own_row(result, experiment, cell, best) for cell in chosen]
    if rows:
        rows[-1] = rows[-1]._replace(last_of_grid=True)
    rows += [_method_row(result, run, best) for run in runs.values()]
    for name in paper.METHODS:
        if runs and name not in runs:
            note = "not asked for" if name in METHODS else "not in this version yet"
            rows.append(_method_row(result, MethodResult(name, note=note), best))
    return rows


def _table_6(result: Reproduction, experiment: Experiment) -> list[GridResult]:
    """Return the last layer at the ratio of Table 6's text and at that of its figures."""
    wanted = [(result.layers[-1], gamma) for gamma in (paper.TEXT_GAMMA, paper.FIGURE_GAMMA)]
    return [cell for cell in experiment.grid if (cell.cell.layer, cell.cell.gamma) in wanted]


def _own_row(
    result: Reproduction, experiment: Experiment, chosen: GridResult, best: Mapping[str, float | None]
) -> MethodRow:
    gamma = chosen.cell.gamma
    source = "text" if gamma == paper.TEXT_GAMMA else "figures"
    milliseconds = experiment.milliseconds.get(gamma) if gamma is not None else None
    known = paper.OURS if result.name in paper.SETS else None
    time = f"{known.milliseconds:.2f}" if known else _DASH
    recall = _DASH if chosen.paper is None else f"{chosen.paper:.2f}"
    return MethodRow(
        f"{chosen.cell.layer} + KL {figures.ratio_name(gamma)}",
        f"{result.network}; by Table 6's {source}",
        ["random weights"] if result.random else [],
        _cells(chosen.metrics, milliseconds, best, recall, time, races=not result.random),
        "",
        recall,
        time,
    )


def _method_row(result: Reproduction, run: MethodResult, best: Mapping[str, float | None]) -> MethodRow:
    known = paper.METHODS.get(run.method) if result.name in paper.SETS else None
    recall = f"{known.recall[result.name]:.2f}" if known else _DASH
    time = f"{known.milliseconds:.2f}" if known else _DASH
    cells = []
    if run.metrics is not None:
        cells = _cells(run.metrics, run.milliseconds, best, recall, time, races=ranks(run))
    marks = run.mark.split(", ") if run.mark else []
    return MethodRow(run.method, run.network, marks, cells, run.note, recall, time)


def _cells(
    metrics: Mapping[str, Any],
    milliseconds: float | None,
    best: Mapping[str, float | None],
    paper_recall: str,
    paper_time: str,
    *,
    races: bool,
) -> list[Cell]:
    cells = []
    for name in MEASURES:
        value, under = metrics[name], ""
        if name == _HEAD and (interval := metrics.get(f"{name}_interval")):
            under = " to ".join(f"{100 * end:.0f}" for end in interval)
        cells.append(Cell(_share(value), races and bool(value) and value == best[name], under))
    cells.insert(1, Cell(paper_recall, paper=True))
    here = _DASH if milliseconds is None else f"{milliseconds:.1f}"
    return [*cells, Cell(here), Cell(paper_time, paper=True)]


def grid_records(result: Reproduction, experiment: Experiment) -> Iterator[dict[str, Any]]:
    """Iterate over the cells of the grid as rows of numbers."""
    for cell in experiment.grid:
        low, high = cell.metrics[f"{_HEAD}_interval"] or (None, None)
        yield {
            "layer": cell.cell.layer,
            "gamma": cell.cell.gamma,
            "components": cell.cell.components,
            "channels": cell.cell.channels,
            "paper_recall_at_100_precision_percent": cell.paper,
            **{name: cell.metrics[name] for name in MEASURES},
            "recall_at_100_precision_low": low,
            "recall_at_100_precision_high": high,
            "rows_with_truth": cell.metrics["rows_with_truth"],
            "fitted_on": cell.cell.fitted_on,
            **_network(result),
        }


def method_records(result: Reproduction, experiment: Experiment) -> Iterator[dict[str, Any]]:
    """Iterate over the rows of Tables 6 and 7 as numbers."""
    in_paper = result.name in paper.SETS
    for cell in _table_6(result, experiment):
        gamma = cell.cell.gamma
        name = f"{cell.cell.layer}-kl-{gamma:g}-netvlad"
        milliseconds = experiment.milliseconds.get(gamma or 0.0)
        info = {
            "weights": {"weights": result.weights},
            "config": result.config.model_dump(),
            "learned_on": [cell.cell.fitted_on],
        }
        mark = "random weights" if result.random else ""
        own = MethodResult(name, cell.metrics, cell.curve, milliseconds, info, mark)
        time = paper.OURS.milliseconds if in_paper else None
        yield {**record(own), "paper_recall_at_100_precision_percent": cell.paper, "paper_ms_an_image": time}
    for run in experiment.methods:
        known = paper.METHODS.get(run.method) if in_paper else None
        yield {
            **record(run),
            "paper_recall_at_100_precision_percent": known.recall[result.name] if known else None,
            "paper_ms_an_image": known.milliseconds if known else None,
        }


def results(result: Reproduction) -> dict[str, Any]:
    """Return all numbers, for JSON."""
    return {
        "data_set": result.name,
        "source": result.source,
        **_network(result),
        "note": result.note,
        "limit": result.limit,
        "machine": result.machine,
        "frames_computed": result.computed,
        "experiments": [
            {
                "view": experiment.view,
                "frames": experiment.frames,
                "protocol": _protocol(experiment),
                "grid": list(grid_records(result, experiment)),
                "methods": list(method_records(result, experiment)),
            }
            for experiment in result.experiments
        ],
    }


def _write_tables(result: Reproduction, experiment: Experiment, folder: Path) -> None:
    number = {"Table 4": "4", "Table 5": "5"}.get(paper.SETS.get(result.name, paper.ANY_SET).table, "4-5")
    facts = {"data_set": result.name, "view": experiment.view, "frames": experiment.frames}
    more = facts | csv_facts(_protocol(experiment), result.machine) | {"view": experiment.view}
    write_csv(folder / f"table-{number}-{experiment.view}.csv", grid_records(result, experiment), more=more)
    write_csv(folder / f"table-6-7-{experiment.view}.csv", method_records(result, experiment), more=more)


def _part(result: Reproduction, experiment: Experiment, names: paper.PaperSet, folder: Path) -> dict[str, Any]:
    line = protocol_line(_protocol(experiment))
    fitted = "; ".join(sorted({cell.cell.fitted_on for cell in experiment.grid}))
    grid_line = (
        f"Protocol: {line}. Basis and clusters fitted on the test images ({fitted}). {_settings(result)} "
        f"Network: {result.network}."
    )
    methods = method_rows(result, experiment)
    return {
        "title": "All images" if experiment.view == "all" else f"{experiment.view.capitalize()} camera",
        "about": f"{experiment.frames} images; {experiment.grid[0].metrics['rows_with_truth']} have a true match.",
        "recall": recall_rows(experiment),
        "precision": recall_rows(experiment, "average_precision"),
        "grid_line": grid_line,
        "methods": methods,
        "methods_line": f"Protocol: {line}.",
        "stand_ins": [f"{row.name}: {row.note}" for row in methods if row.cells and row.note],
        "figures": [_saved(item, folder, experiment.view) for item in _figures(result, experiment, names)],
    }


class _Picture(NamedTuple):
    file: str
    title: str
    about: str
    figure: Figure
    of_network: bool = True


def _figures(result: Reproduction, experiment: Experiment, names: paper.PaperSet) -> Iterator[_Picture]:
    grid = experiment.grid
    yield _Picture(
        "figure-12-spectrum",
        "Figure 12: sorted spectrum of the Karhunen-Loeve transform",
        "Eigenvalues of each layer, largest first, and the energy that the first of them hold.",
        figures.spectra(grid),
    )
    yield _Picture(
        "figure-17-truth",
        f"{names.truth_figure}: truth",
        "Each point is a pair of frames that show one place.",
        figures.truth_matrix(experiment.truth),
        of_network=False,
    )
    yield _Picture(
        f"{_file(names.distance_figure)}-distances",
        f"{names.distance_figure}: distances of sequences",
        "Without the transform and at each ratio; dark is alike. One scale a layer.",
        figures.distance_matrices(grid, experiment.frames),
    )
    yield _Picture(
        f"{_file(names.layers_figure)}-layers",
        f"{names.layers_figure}: precision over recall by layer and ratio",
        "Every distinct score is a threshold.",
        figures.curves_by_layer(grid),
    )
    curves = {f"{c.cell.layer} + KL {figures.ratio_name(c.cell.gamma)}": c.curve for c in _table_6(result, experiment)}
    curves |= {run.method: run.curve for run in experiment.methods if run.curve is not None}
    yield _Picture(
        f"{_file(names.methods_figure)}-methods",
        f"{names.methods_figure}: precision over recall by method",
        "The open marks are recall at 100 % precision.",
        precision_recall(curves),
    )


def _file(figure: str) -> str:
    return figure.lower().replace("figures", "figure").replace(" and ", "-").replace(" ", "-")


def _saved(item: _Picture, folder: Path, view: str) -> dict[str, Any]:
    picture = png(item.figure)
    (folder / f"{item.file}-{view}.png").write_bytes(picture)
    width = round(PIXELS_PER_INCH * item.figure.get_figwidth())
    return {**item._asdict(), "image": embed(picture), "width": width}


def _protocol(experiment: Experiment) -> Mapping[str, Any]:
    protocol: Mapping[str, Any] = experiment.grid[0].metrics["protocol"]
    return protocol


def _network(result: Reproduction) -> dict[str, Any]:
    return {
        "backbone": result.config.features.backbone,
        "weights": result.weights,
        "weights_sha256": result.weights_sha256,
        "random": result.random,
    }


def _settings(result: Reproduction) -> str:
    config = result.config
    window = config.aggregation.centre_window
    return (
        f"Input {config.features.width} x {config.features.height}, sequences of {config.sequence.length} frames, "
        f"{config.aggregation.clusters} clusters, "
        + (f"the mean of the last {window} frames taken out." if window else "nothing taken out of the descriptors.")
    )


def _lead(result: Reproduction) -> str:
    frames = " and ".join(str(experiment.frames) for experiment in result.experiments)
    beside = "beside the paper's own numbers" if result.name in paper.SETS else "on data that the paper did not use"
    return f"Tables 4 to 7 of Jiang, Zhou and Sun 2024 on {frames} images, {beside}. Network: {result.network}."


def _warnings(result: Reproduction) -> Iterator[tuple[str, str]]:
    if result.random:
        yield (
            "Random weights.",
            "This network was never trained. Its numbers show that the machinery runs and say nothing about accuracy.",
        )
    if result.note:
        yield "The embedded network stands in.", f"Its layers are not the paper's. The reason: {result.note}"
    if result.limit is not None:
        yield "A quick look.", f"At most the first {result.limit} images of each camera were used."


def _facts(result: Reproduction) -> list[tuple[str, str]]:
    config = result.config
    alpha = config.decision.threshold
    protocol = _protocol(result.experiments[0])
    return [
        ("Images", result.source),
        ("Truth SHA-256", str(protocol["truth_hash"])),
        ("Network", f"{result.network}; layers {', '.join(result.layers)}"),
        ("Weights SHA-256", result.weights_sha256 or "none: drawn, not learned"),
        ("Settings", _settings(result)),
        ("Threshold", "the method's own" if alpha is None else f"score {alpha:g}, a distance alpha of {1 - alpha:.1f}"),
        ("Machine", result.machine),
        ("Paper", "Jiang, Zhou, Sun, Appl. Sci. 2024, 14(1), 8, doi 10.3390/app14010008"),
    ]


def _share(value: float | None) -> str:
    return percent(value).removesuffix(" %")
