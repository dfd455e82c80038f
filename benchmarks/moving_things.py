"""Moving things: places found while people and cars cover up to 60 % of the view.

    OMP_NUM_THREADS=1 python benchmarks/moving_things.py [--data FOLDER] [--seeds 40,41] [--shares 0,0.3,0.6]
        [--methods 'a;b'] [--picture FILE.png] [--pasted FILE.png]

Simulated drives of 200 frames, one stream, by day and by day, then dusk; and Gardens Point, day_right against day_left,
with people, bicyclists and cars pasted in: cut out of `street/images` by `street/labels`, placed on the ground ahead of
a camera at eye height and moving from frame to frame, other ones in each traverse. A seed is a street or a crowd, and
figures are means over the seeds. `covered` is the mean share of the view behind what moves. A match is right within 2
frames, and frames with a full sequence behind them count.

FOLDER holds `gardens_point` and `street`; without them the simulated drives alone are measured, and `bow` learns its
words from the drive instead of from `street/images`. `--picture` draws the curves and simulated views; `--pasted` draws
pasted ones, to be looked at: the photographs are not ours to publish.
"""

import argparse
import io
import tempfile
from functools import cache, partial
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np
from baselines import Remembered, data_argument, fitted_before, kind_of, make_detector
from PIL import Image

from loopclosure import Config, ImageSequence
from loopclosure.evaluation import LoopLog, evaluate, load_truth
from loopclosure.evaluation.machine import describe_machine
from loopclosure.images.simulator import Drive, SimulationSettings
from loopclosure.images.simulator.write import true_pairs
from loopclosure.report.style import GRID, dress, key, line_styles, new_figure, png

SHARES = 0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6
LENGTH, FRAMES, EXAMPLE = 10, 200, 150
CENTRED = {"aggregation.components": 0, "verification.mode": "none"}
PAPER = CENTRED | {"aggregation.centre_window": 0}  # the paper's chain: nothing is taken out of a descriptor
METHODS = {
    "NetVLAD, no KL": PAPER,
    **{f"KL {gamma:.0%}, NetVLAD": PAPER | {"compression.gamma": gamma} for gamma in (0.0, 0.6, 0.7, 0.8, 0.9)},
    "as shipped": {},
    "seqslam": {"method": "seqslam"},
    "bow": {"method": "bow"},
    "NetVLAD, no KL, centred": CENTRED,
    "KL 80%, NetVLAD, centred": CENTRED | {"compression.gamma": 0.8},
    "as shipped, not verified": {"verification.mode": "none"},
    "the same, no layout": {"verification.mode": "none", "aggregation.layout_weight": 0},
    "the same, what rides along counts": {"verification.mode": "none", "aggregation.change_over": 0},
    "the same, neither": {"verification.mode": "none", "aggregation.layout_weight": 0, "aggregation.change_over": 0},
}
DRAWN = 9  # the first of them; more lines cannot be told apart
DRIVES = {"sim, day": "day", "sim, day then dusk": "dusk"}
PASTED = "Gardens Point, pasted"

SIZE = 640, 360  # of the photographs, pixels
FOCAL, HORIZON, EYE_M = 0.85, 0.48, 1.5  # shares of the width and of the height
LEAST_HEIGHT = 60  # of a thing in the picture that it is cut out of, pixels
LEAST_COVERED = 0.3  # of its box: less is half hidden


class Kind(NamedTuple):
    """A class of `street/labels`: its share, its height, shapes, and how near and how fast its things may be."""

    share: float
    height_m: float
    width_to_height: tuple[float, float]
    nearest_m: float
    farthest_m: float
    ahead_m: float  # a frame, at most
    aside_m: float


KINDS = {
    8: Kind(0.3, 1.5, (0.7, 2.5), 3.5, 12.0, 0.3, 0.3),
    9: Kind(0.5, 1.75, (0.15, 0.7), 1.5, 9.0, 0.15, 0.1),
    10: Kind(0.2, 1.8, (0.15, 0.7), 2.0, 9.0, 0.3, 0.2),
}


class Track(NamedTuple):
    """One thing in the frames of a traverse in which it is seen."""

    pixels: np.ndarray
    height_m: float
    frames: range
    ahead_m: np.ndarray
    aside_m: np.ndarray


def cut_out(street):
    """Return for each kind RGBA pictures of its things, whole ones as far as the labels can tell."""
    found = {label: [] for label in KINDS}
    for image in sorted((street / "images").iterdir()):
        rgb = cv2.cvtColor(cv2.imread(str(image)), cv2.COLOR_BGR2RGB)
        labels = cv2.imread(str(street / "labels" / f"{image.stem}.png"), cv2.IMREAD_GRAYSCALE)
        for label, kind in KINDS.items():
            _, parts, boxes, _ = cv2.connectedComponentsWithStats((labels == label).astype(np.uint8))
            for part, (x, y, width, height, area) in enumerate(boxes[1:], 1):
                inside = x > 0 and y > 0 and x + width < labels.shape[1] and y + height < labels.shape[0]
                shaped = kind.width_to_height[0] < width / height < kind.width_to_height[1]
                if inside and shaped and height >= LEAST_HEIGHT and area > LEAST_COVERED * width * height:
                    box = np.s_[y : y + height, x : x + width]
                    found[label].append(np.dstack([rgb[box], 255 * (parts[box] == part).astype(np.uint8)]))
    return found


def paint(canvas, thing, frame):
    """Paint a thing on an RGBA canvas, whose last channel says what is covered."""
    rows, columns = canvas.shape[:2]
    at = frame - thing.frames.start
    metre = FOCAL * columns / thing.ahead_m[at]  # pixels of a metre, there
    scale = metre * thing.height_m / len(thing.pixels)
    left = columns / 2 + metre * thing.aside_m[at] - scale * thing.pixels.shape[1] / 2
    top = HORIZON * rows + metre * (EYE_M - thing.height_m)
    layer = cv2.warpAffine(thing.pixels, np.float32([[scale, 0, left], [0, scale, top]]), (columns, rows))
    seen = layer[..., 3] > 127
    canvas[seen] = layer[seen]


def new_track(things, middle, frames, rng):
    """Return a thing that crosses the view about the frame `middle`."""
    label = rng.choice(list(KINDS), p=[kind.share for kind in KINDS.values()])
    kind = KINDS[label]
    pixels = things[label][rng.integers(len(things[label]))]
    if rng.random() < 0.5:
        pixels = np.ascontiguousarray(pixels[:, ::-1])
    half = int(rng.integers(5, 13))
    seen = range(max(middle - half, 0), min(middle + half, frames - 1) + 1)
    time = np.arange(seen.start, seen.stop) - middle
    ahead = rng.uniform(kind.nearest_m, kind.farthest_m)
    aside = rng.uniform(-0.5, 0.5) * ahead / FOCAL
    ahead_m = np.maximum(ahead + rng.uniform(-1, 1) * kind.ahead_m * time, kind.nearest_m)
    return Track(pixels, kind.height_m, seen, ahead_m, aside + rng.uniform(-1, 1) * kind.aside_m * time)


def traffic(things, frames, share, seed):
    """Return tracks that cover a share of the view; those of a smaller share are among them."""
    rng, tracks = np.random.default_rng(seed), []
    small = np.zeros((frames, SIZE[1] // 8, SIZE[0] // 8, 4), np.uint8)
    covered = np.zeros(frames)
    while covered.mean() < share:
        track = new_track(things, int(covered.argmin()), frames, rng)
        for frame in track.frames:
            paint(small[frame], track, frame)
            covered[frame] = (small[frame, ..., 3] > 0).mean()
        tracks.append(track)
    return tracks


def paste(images, tracks):
    """Return the images behind the things, far ones first, and the mean share of the view that is covered."""
    pasted, covered = [], []
    for frame, image in enumerate(images):
        canvas = np.dstack([image, np.zeros(image.shape[:2], np.uint8)])
        here = [track for track in tracks if frame in track.frames]
        for track in sorted(here, key=lambda track: -track.ahead_m[frame - track.frames.start]):
            paint(canvas, track, frame)
        pasted.append(np.ascontiguousarray(canvas[..., :3]))
        covered.append((canvas[..., 3] > 0).mean())
    return pasted, np.mean(covered)


class Case(NamedTuple):
    """Images of a reference or None, images, truth, the rows that count, and the share that is covered."""

    reference: list | None
    images: list
    truth: object
    counted: np.ndarray
    covered: float


def simulated(light, seed, share):
    drive = Drive(SimulationSettings(frames=FRAMES, seed=seed, covered=share, revisit_light=light))
    frames = list(drive)
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "truth.csv"
        np.savetxt(file, true_pairs(drive), fmt="%d", delimiter=",", header="query,match", comments="")
        truth = load_truth(file, frames=(FRAMES, None), exclude_recent=drive.settings.exclude_recent)
    full = np.arange(FRAMES) >= drive.first_lap + LENGTH - 1
    counted = np.flatnonzero(full | (truth.matches_per_query() == 0))
    return Case(None, [frame.image for frame in frames], truth, counted, np.mean([frame.covered for frame in frames]))


@cache
def photographs(folder):
    return [cv2.resize(image, SIZE, interpolation=cv2.INTER_AREA) for image in ImageSequence(folder)]


def gardens_point(data, things, seed, share):
    sides = []
    for side, name in enumerate(("day_left", "day_right")):
        images = photographs(data / "gardens_point" / name)
        own = {label: found[side * len(found) // 2 :][: len(found) // 2] for label, found in things.items()}
        sides.append(paste(images, traffic(own, len(images), share, (seed, side))))
    (reference, covered), (images, also) = sides
    truth = load_truth(data / "gardens_point" / "truth.csv", frames=(len(images), len(reference)))
    return Case(reference, images, truth, np.arange(LENGTH - 1, len(images)), (covered + also) / 2)


def figures(case, settings, features, model):
    """Return recall at 100 % and at 95 % precision, 0 where it is undefined, and top-1."""
    config = Config().with_settings({"sequence.length": LENGTH, **settings})
    detector = make_detector(config, model, features)
    if case.reference is not None:
        detector.set_reference(case.reference)
    log = LoopLog.from_decisions(detector.add(image) for image in case.images)
    metrics = evaluate(log, case.truth, tolerance=0, queries=case.counted, bootstrap=0).metrics  # the truth has +-2
    return metrics["recall_at_100_precision"] or 0.0, metrics["recall_at_95_precision"] or 0.0, metrics["top1"]


def measure(case, methods, networks, models):
    """Return the figures of each method, features computed once for each image."""
    known = {kind: Remembered(network) for kind, network in networks.items()}
    names = [METHODS[method].get("method", "kl-netvlad") for method in methods]
    return [
        figures(case, METHODS[method], known[kind_of(name)], models.get(name))
        for method, name in zip(methods, names, strict=True)
    ]


def sweep(case_of, methods, seeds, shares, networks, models):
    """Return covered shares (s,) and figures (s, methods, 3), means over the seeds, and a frame of each share."""
    covered, found, views = [], [], {}
    for share in shares:
        rows = []
        for seed in seeds:
            case = case_of(seed, share)
            rows.append((case.covered, measure(case, methods, networks, models)))
            views.setdefault(f"{share:.0%} covered", case.images[EXAMPLE])
        covered.append(np.mean([here for here, _ in rows]))
        found.append(np.mean([row for _, row in rows], axis=0))
    return np.array(covered), np.array(found), views


def show(title, methods, covered, found):
    print(f"\n{title}: recall at 100 % / at 95 % precision / top-1, percent")
    print("| covered | " + " | ".join(f"{share:.0%}" for share in covered) + " |\n|---" + "|---" * len(covered) + "|")
    for name, row in zip(methods, found.transpose(1, 0, 2), strict=True):
        print(f"| {name} | " + " | ".join("/".join(f"{100 * one:.0f}" for one in cell) for cell in row) + " |")


def draw(results, methods):
    """Return a figure of the curves, above views of one simulated place."""
    figure = new_figure(4.1 * len(results), 6.0)
    above, below = figure.subfigures(2, 1, height_ratios=(2.8, 1))
    styles, lines = dict(zip(methods, line_styles(len(methods)), strict=True)), []
    panels = np.ravel(above.subplots(1, len(results), sharey=True))
    for axes, (title, (covered, found, _)) in zip(panels, results.items(), strict=True):
        lines = [
            axes.plot(100 * covered, 100 * found[:, i, 0], label=name, markersize=4, **styles[name])[0]
            for i, name in enumerate(methods[:DRAWN])
        ]
        axes.set_ylim(-3, 103)
        first = axes is panels[0]
        dress(axes, title=title, x="covered share of the view, %", y="recall at 100 % precision, %" if first else "")
    key(above, lines)
    show_views(below, results[next(iter(DRIVES))][2])
    return figure


def show_views(figure, views):
    """Show titled images side by side."""
    for axes, (title, image) in zip(np.ravel(figure.subplots(1, len(views))), views.items(), strict=True):
        axes.imshow(image)
        dress(axes, title=title, x="", y="", grid=False)
        axes.set(xticks=[], yticks=[])
        axes.spines[:].set_color(GRID)


def save(figure, path):
    """Write a figure in 256 colours: the views in all of them take three times the bytes."""
    Image.open(io.BytesIO(png(figure))).quantize(256).save(path, optimize=True)


def networks_for(methods, **settings):
    """Return what computes features, by what these are shared under."""
    names = {METHODS[method].get("method", "kl-netvlad") for method in methods}
    return {
        kind_of(name): make_detector(Config(method=name).with_settings(settings), None).method.features
        for name in names
    }


def all_cases(data, methods, networks):
    """Return by name: a function of seed and share to a case, and the networks that look at its images."""
    own_size = networks
    if "bow" in methods:  # it would enlarge simulated images
        own_size = networks | networks_for(["bow"], **{"words.side": SimulationSettings().width})
    found = {title: (partial(simulated, light), own_size) for title, light in DRIVES.items()}
    if (data / "street").is_dir():
        things = cut_out(data / "street")
        print("things cut out, by label:", {label: len(pixels) for label, pixels in things.items()}, flush=True)
        found[PASTED] = partial(gardens_point, data, things), networks
    return found


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    data_argument(parser)
    parser.add_argument("--seeds", default="40")
    parser.add_argument("--shares", default=",".join(map(str, SHARES)))
    parser.add_argument("--methods", default=";".join(METHODS))
    parser.add_argument("--picture", type=Path, help="draw the curves and simulated views there")
    parser.add_argument("--pasted", type=Path, help="draw photographs with things pasted in there")
    args = parser.parse_args()
    seeds, shares = [int(seed) for seed in args.seeds.split(",")], [float(share) for share in args.shares.split(",")]
    methods = args.methods.split(";")
    print(describe_machine(), flush=True)
    networks, models, results = networks_for(methods), {}, {}
    with tempfile.TemporaryDirectory() as folder:
        if "bow" in methods and (args.data / "street").is_dir():
            models["bow"] = fitted_before("bow", args.data, Remembered(networks["words"]), Path(folder) / "bow")
        for title, (case_of, its_networks) in all_cases(args.data, methods, networks).items():
            results[title] = sweep(case_of, methods, seeds, shares, its_networks, models)
            show(title, methods, *results[title][:2])
    if args.picture:
        save(draw(results, methods), args.picture)
    if args.pasted and PASTED in results:
        figure = new_figure(12, 2.2)
        show_views(figure, results[PASTED][2])
        save(figure, args.pasted)


if __name__ == "__main__":
    main()
