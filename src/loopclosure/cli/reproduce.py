"""``loopclosure reproduce``."""

from __future__ import annotations

import json as jsonlib
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from loopclosure.cli import app
from loopclosure.cli.console import print_json, progress_bars, say
from loopclosure.cli.options import Json, Quiet, parse_pair
from loopclosure.config import Config
from loopclosure.evaluation.tables import NanPoses

if TYPE_CHECKING:
    from loopclosure.evaluation.experiments import Reproduction

Views = Literal["left", "right", "both", "all"]


@app.command()
def reproduce(
    data_set: Annotated[str, typer.Argument(help="new-college, city-centre, or a name for your own data.")] = "custom",
    images: Annotated[Path | None, typer.Option(help="Folder of images or of the data set, or text file.")] = None,
    truth: Annotated[Path | None, typer.Option(help="Truth file, as for `evaluate`.")] = None,
    out: Annotated[Path, typer.Option(help="Folder to write; what is finished in it is not done again.")] = Path(
        "reproduce"
    ),
    backbone: Annotated[str | None, typer.Option(help="Network (default: the paper's, resnet152).")] = None,
    weights: Annotated[str | None, typer.Option(help="'default', a name, a path, or 'random'.")] = None,
    layers: Annotated[str, typer.Option(help="Taps with commas between them (default: all).")] = "",
    methods: Annotated[str, typer.Option(help="Methods of Tables 6 and 7: a,b,c, all, or none.")] = "all",
    view: Annotated[Views | None, typer.Option(help="Cameras of a set of left and right images by turns.")] = None,
    tolerance: Annotated[
        int | None, typer.Option(min=0, help="A match so many frames from a true one is right.")
    ] = None,
    limit: Annotated[int | None, typer.Option(help="Only so many first images of each camera: a quick look.")] = None,
    exclude_recent: Annotated[int | None, typer.Option(help="Frames nearer than this are no candidates.")] = None,
    key: Annotated[str | None, typer.Option(help="Name of the matrix in a .mat file.")] = None,
    radius: Annotated[float | None, typer.Option("--radius", help="Truth by poses: same place, metres.")] = None,
    nan_poses: Annotated[NanPoses | None, typer.Option(help="Frames without a position: error, ignore.")] = None,
    set_: Annotated[
        list[str] | None, typer.Option("--set", metavar="STAGE.FIELD=VALUE", help="Any setting; may be repeated.")
    ] = None,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Do the paper's experiments: Tables 4 to 7 and Figures 12 and 17 to 23, beside the paper's own numbers.

    Images pass the network once; a run that was interrupted goes on where it stopped. Settings are the paper's
    (`--preset paper` of other commands). Where ResNet-152's weights are not to be had, the embedded network stands in.

    Examples:

      loopclosure reproduce new-college --images ~/NewCollege --out reproduce

      loopclosure reproduce city-centre --view left --limit 200 --methods none

      loopclosure reproduce --images drive/images --truth drive/truth.csv --backbone efficientnet-lite0 --tolerance 2
    """
    from loopclosure.evaluation.experiments import reproduce as run_experiments
    from loopclosure.report.experiments import results, write_experiments
    from loopclosure.runs import write_whole

    settings = dict(map(parse_pair, set_ or ()))
    flags = {
        "features.backbone": backbone,
        "features.weights": weights,
        "sequence.exclude_recent": exclude_recent,
    }
    settings |= {name: str(value) for name, value in flags.items() if value is not None}
    with progress_bars(quiet=quiet or json) as progress:
        result = run_experiments(
            data_set,
            out,
            images=images,
            truth=truth,
            truth_settings={"key": key, "radius_m": radius, "nan_poses": nan_poses},
            config=Config.preset("paper").with_settings(settings),
            layers=[layer.strip() for layer in layers.split(",") if layer.strip()],
            view=view,
            tolerance=tolerance,
            methods=methods,
            limit=limit,
            progress=progress,
        )
        page = write_experiments(result, out)
    numbers = results(result)
    write_whole(out / "results.json", jsonlib.dumps(numbers, indent=2) + "\n")
    if json:
        print_json(numbers)
        return
    _print_tables(result, quiet=quiet)
    if result.note:
        say(f"the embedded network stands in: {result.note}", quiet=quiet)
    say(f"{result.computed} images passed the network; look at {page}", quiet=quiet)


def _print_tables(result: Reproduction, *, quiet: bool) -> None:
    """Print recall at 100 % precision in percent; the paper's own in brackets."""
    from loopclosure.evaluation.paper import GAMMAS
    from loopclosure.report.comparison import protocol_line
    from loopclosure.report.experiment_figures import ratio_name
    from loopclosure.report.experiments import method_rows, recall_rows

    for experiment in result.experiments:
        say(f"{result.name}, {experiment.view}: R@100P in percent (the paper's), {result.network}", quiet=quiet)
        say(f"{'layer':<8}" + "".join(f"{ratio_name(gamma):>18}" for gamma in (None, *GAMMAS)), quiet=quiet)
        for row in recall_rows(experiment):
            cells = (f"{cell.text} ({cell.under.removeprefix('paper ')})" for cell in row.cells)
            say(f"{row.name:<8}" + "".join(f"{cell:>18}" for cell in cells), quiet=quiet)
        say(f"{'method':<30}{'R@100P':>18}{'ms an image':>18}", quiet=quiet)
        for line in method_rows(result, experiment):
            if line.cells:
                recall, time = (
                    f"{line.cells[0].text} ({line.paper_recall})",
                    f"{line.cells[-2].text} ({line.paper_time})",
                )
                marks = ", ".join(line.marks)
                say(f"{line.name:<30}{recall:>18}{time:>18}  {marks}".rstrip(), quiet=quiet)
            else:
                say(f"{line.name:<30}  {line.note}", quiet=quiet)
        protocol = experiment.grid[0].metrics["protocol"]
        say(f"protocol: {protocol_line(protocol)}", quiet=quiet)
    say(f"machine: {result.machine}", quiet=quiet)
