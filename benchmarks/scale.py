"""A map of up to a million places: time of a query and of an `add`, recall, memory.

    python benchmarks/scale.py [--places 1000000] [--streets 8] [--picture docs/images/scale.png] [--first-looks]
    python benchmarks/scale.py --detector [--places 200000] [--streets 8]

Where the descriptors come from: simulated streets, each driven twice, go through the embedded network, NetVLAD beside
the layout, and the whitening KL transform behind them (128 numbers). Every further street is made of two of these,
mixed 0.85 to 0.5: one whose whitened components change sign at random, and one that 50 neighbouring streets share. A
change of signs keeps all similarities within a street as they were measured and the covariance white; the shared part
makes streets of one quarter look alike. The map holds first laps, queries are second laps.

One map grows through all sizes, and every figure is of that one run: medians of 200 queries, of the last 5,000 adds.
Exact answers come from all cosines. ``same_best`` is the share of frames whose best sequence on the shortlist is the
best of all sequences, on streets that the map holds and on streets that it does not. ``ratio`` is that of a query to
the first size.
"""

from __future__ import annotations

import argparse
import ctypes
import gc
import itertools
import os
import time

import numpy as np

from loopclosure.aggregation.centring import centre_traverse
from loopclosure.aggregation.netvlad import unit
from loopclosure.config import Config
from loopclosure.detect import LoopDetector
from loopclosure.evaluation.machine import describe_machine
from loopclosure.images.simulator import Drive, SimulationSettings
from loopclosure.matching.index import PlaceIndex
from loopclosure.matching.sequences import SequenceScores
from loopclosure.matching.shortlist import SequenceSearch
from loopclosure.methods import build_method
from loopclosure.report.style import line_styles, new_figure

SIZES = (10_000, 30_000, 100_000, 300_000, 1_000_000)
NUMBERS, LAP, QUARTER = 128, 200, 50
QUERIES, ADDS, NEIGHBOURS, LENGTH = 200, 5_000, 10, 10


def measured_laps(streets):
    """Descriptors of simulated streets, float32 (streets, 2, LAP, NUMBERS)."""
    method, features = build_method(Config()), []
    for seed in range(streets):
        images = (frame.image for frame in Drive(SimulationSettings(frames=2 * LAP, seed=seed)))
        while batch := list(itertools.islice(images, 8)):
            features += [map_.astype(np.float16) for map_ in method.features(batch)]
    method.fit([map_.astype(np.float32) for map_ in features[:: max(len(features) // 500, 1)]])
    described = np.stack([method.describe([map_.astype(np.float32)]) for map_ in features])
    centred = np.concatenate([centre_traverse(lap, window=60)[0] for lap in np.split(described, 2 * streets)])
    return np.stack([method.reduce(one) for one in centred]).reshape(streets, 2, LAP, NUMBERS)


def street(laps, number, *, lap):
    """Descriptors of one lap of a street, float32 (LAP, NUMBERS)."""
    own, shared = (signed(laps, seed)[lap] for seed in (2 * number, 2 * (number // QUARTER) + 1))
    return unit(0.85 * own + 0.5 * shared)


def signed(laps, seed):
    rng = np.random.default_rng(seed)
    return laps[rng.integers(len(laps))] * rng.choice(np.float32([-1, 1]), NUMBERS)


def resident():
    """Memory of this process that is in RAM, bytes, without what was freed but not given back."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE")


def seconds(function, *args, **kwargs):
    start = time.perf_counter()
    result = function(*args, **kwargs)
    return time.perf_counter() - start, result


def queries_of(places, laps):
    """Second laps: single frames from all over the map."""
    rng = np.random.default_rng(len(places))
    ids = rng.integers(0, len(places), QUERIES)
    return np.stack([street(laps, i // LAP, lap=1)[i % LAP] for i in ids])


def recall_and_times(places, queries):
    """Median seconds of a query and of an exact one, and the share of the exact neighbours that were found."""
    times, exact_times, found = [], [], []
    for query in queries:
        took, (ids, _) = seconds(places.search, query, NEIGHBOURS)
        exact_took, similarities = seconds(places.similarities, query)
        found.append(np.isin(np.argpartition(-similarities, NEIGHBOURS)[:NEIGHBOURS], ids).mean())
        times.append(took)
        exact_times.append(exact_took)
    return np.median(times), np.median(exact_times), np.mean(found)


def sequences(places, laps, number):
    """Median seconds of a sequence search on the second lap of a street, and how often its best is the best of all."""
    search, everything, times, same = SequenceSearch(places, SequenceScores(LENGTH)), SequenceScores(LENGTH), [], []
    for frame, row in enumerate(street(laps, number, lap=1), start=1):
        took, found = seconds(search.push, row)
        wanted = everything.push(places.similarities(row))
        if frame >= LENGTH:
            times.append(took)
            same.append(np.nanargmax(found.row()) == np.nanargmax(wanted))
    return np.median(times), np.mean(same)


def measure(places, laps, adds, empty):
    rss = resident() - empty
    query, exact, recall = recall_and_times(places, queries_of(places, laps))
    streets = len(places) // LAP
    known = [sequences(places, laps, streets * i // 3) for i in (1, 2)]
    unknown = [sequences(places, laps, streets + QUARTER + i) for i in (1, 2)]
    last = 1e6 * adds[-ADDS:]
    return {
        "places": len(places),
        "query_ms": 1e3 * query,
        "exact_ms": 1e3 * exact,
        "recall_at_10": recall,
        "search_ms": 1e3 * np.median([took for took, _ in known + unknown]),
        "same_best_seen": np.mean([same for _, same in known]),
        "same_best_new": np.mean([same for _, same in unknown]),
        "add_us": np.median(last),
        "add_p99_us": np.percentile(last, 99),
        "add_mean_us": last.mean(),
        "add_worst_ms": 1e3 * adds.max(),
        "bytes_a_place": places.nbytes / len(places),
        "rss_a_place": rss / len(places),
        "built_s": adds.sum(),
    }


def grow(laps, sizes):
    """Yield the figures at each size."""
    places, adds, count = PlaceIndex(), np.full(sizes[-1], np.nan), 0
    empty = resident()
    for size in sizes:
        while count < size:
            for row in street(laps, count // LAP, lap=0):
                adds[count], _ = seconds(places.add, row)
                count += 1
        yield measure(places, laps, adds[:count], empty)


def first_looks(laps, count):
    """Print the time of ways to find 1,000 survivors, and how many of the 10 nearest are among them."""
    import faiss

    rows = np.concatenate([street(laps, number, lap=0) for number in range(count // LAP)])
    queries, inner = queries_of(rows, laps), faiss.METRIC_INNER_PRODUCT
    exact = [np.argpartition(-(rows @ query), NEIGHBOURS)[:NEIGHBOURS] for query in queries]
    codes = faiss.IndexPQFastScan(NUMBERS, NUMBERS // 2, 4, inner)
    clusters = int(4 * np.sqrt(count))
    kmeans = faiss.Kmeans(NUMBERS, clusters, niter=10, spherical=True, max_points_per_centroid=64, seed=0)
    kmeans.train(rows)
    nearest = faiss.IndexFlatIP(NUMBERS)
    nearest.add(kmeans.centroids)
    lists = faiss.IndexIVFPQFastScan(nearest, NUMBERS, clusters, NUMBERS // 2, 4, inner)
    lists.by_residual = False
    looks = [(f"1/{share} of {clusters} lists", lists, clusters // share) for share in (16, 8, 4, 2)]
    for index in (codes, lists):
        index.train(rows[:: count // 20_000 or 1])
        index.add(rows)
    for name, index, probes in [("all codes", codes, 0), *looks]:
        how = {"params": faiss.SearchParametersIVF(nprobe=probes)} if probes else {}
        found = [seconds(index.search, query[None], 1000, **how) for query in queries]
        recall = np.mean([np.isin(right, ids[0]).mean() for right, (_, (_, ids)) in zip(exact, found, strict=True)])
        print(f"| {name} | {1e3 * np.median([took for took, _ in found]):.2f} | {recall:.3f} |")


def detector_of(rows, flat_up_to):
    """A detector without network and verification; the colour of an image is the number of its row."""
    settings = {"verification.mode": "none", "matching.flat_up_to": flat_up_to}
    detector = LoopDetector(Config().with_settings(settings))
    method = detector.method
    method.fitted, method.centred = True, False
    method.features = lambda images: [rows[image[0, 0] @ np.array([1, 256, 65536])] for image in images]
    method.describe = lambda features: features[-1]
    return detector


def images_of(numbers):
    return [np.broadcast_to(np.array([number], "<u4").view(np.uint8)[:3], (16, 16, 3)) for number in numbers]


def through_the_detector(laps, sizes):
    """Yield, for each size, what `LoopDetector.add` takes and finds on second laps, against a map of first laps."""
    for size in sizes:
        driven = [size // LAP * i // 5 for i in range(1, 5)]
        laps_of = [(number, 0) for number in range(size // LAP)] + [(number, 1) for number in driven]
        rows = np.concatenate([street(laps, number, lap=lap) for number, lap in laps_of])
        places = np.concatenate([number * LAP + np.arange(LAP) for number in driven])
        times, matches, accepted = [], [], []
        for flat_up_to in (Config().matching.flat_up_to, size):
            detector = detector_of(rows, flat_up_to)
            detector.set_reference(images_of(range(size)))
            results = [seconds(detector.add, image) for image in images_of(range(size, len(rows)))]
            times.append(1e3 * np.median([took for took, _ in results[LENGTH:]]))
            matches.append(np.array([decision.match for _, decision in results[LENGTH:]]))
            accepted.append(np.array([decision.accepted for _, decision in results[LENGTH:]]))
        right = abs(matches[0] - places[LENGTH:]) <= 3
        yield {
            "places": size,
            "add_ms": times[0],
            "add_all_ms": times[1],
            "same_match": np.mean(matches[0] == matches[1]),
            "same_accepted": np.mean(accepted[0] == accepted[1]),
            "accepted": np.mean(accepted[0]),
            "right": np.mean(right[accepted[0]]),
        }


def draw(rows, path):
    figure = new_figure(9, 3.6, gap=0.06)
    time_axes, memory_axes = figure.subplots(1, 2)
    count = [row["places"] for row in rows]
    lines = (("query_ms", "10 nearest, index"), ("exact_ms", "all cosines"), ("search_ms", "sequences, shortlist"))
    for (name, label), style in zip(lines, line_styles(len(lines)), strict=True):
        time_axes.loglog(count, [row[name] for row in rows], label=label, **style)
    time_axes.set(xlabel="places in the map", ylabel="milliseconds a frame")
    time_axes.legend()
    for (name, label), style in zip(
        (("rss_a_place", "process"), ("bytes_a_place", "vectors and codes")), line_styles(2), strict=True
    ):
        memory_axes.semilogx(count, [row[name] for row in rows], label=label, **style)
    memory_axes.set(xlabel="places in the map", ylabel="bytes a place", ylim=(0, 800))
    memory_axes.legend()
    figure.savefig(path)


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, default=SIZES[-1])
    parser.add_argument("--streets", type=int, default=8, help="streets that are simulated, 400 frames each")
    parser.add_argument("--laps", help=".npy of their descriptors: read where it exists, written where it does not")
    parser.add_argument("--picture", help="write the curves there")
    parser.add_argument("--detector", action="store_true", help="measure LoopDetector.add against maps of these sizes")
    parser.add_argument("--first-looks", action="store_true", help="only compare ways to find 1,000 survivors")
    args = parser.parse_args()
    if args.laps and os.path.exists(args.laps):
        laps = np.load(args.laps, allow_pickle=False)
    else:
        laps = measured_laps(args.streets)
        if args.laps:
            np.save(args.laps, laps)
    print(describe_machine())
    revisit = np.median((laps[:, 0] * laps[:, 1]).sum(-1))
    print(f"{len(laps)} simulated streets; median cosine of a place seen again {revisit:.2f}")
    if args.first_looks:
        first_looks(laps, args.places)
        return
    rows = []
    most = max(args.places // LAP, 1) * LAP
    sizes = sorted({size for size in SIZES if size < most} | {most})
    for row in through_the_detector(laps, sizes) if args.detector else grow(laps, sizes):
        if not args.detector:
            row["ratio"] = row["query_ms"] / (rows or [row])[0]["query_ms"]
        if not rows:
            print("| " + " | ".join(row) + " |\n" + "|---" * len(row) + "|")
        rows.append(row)
        figures = row.values()
        print("| " + " | ".join(f"{figure:,.7g}" if figure >= 1e4 else f"{figure:.3g}" for figure in figures) + " |")
    if args.picture:
        draw(rows, args.picture)


if __name__ == "__main__":
    main()
