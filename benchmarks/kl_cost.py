"""Does the Karhunen-Loeve transform pay in time? Describing, matching and memory by gamma, and cheaper ways to do it.

    python benchmarks/kl_cost.py [--places 1000 10000 100000] [--rounds 9]

Maps and places are made numbers of the right shapes: what is timed does not depend on their values. Everything that is
compared takes turns, a figure is the median of the rounds, and a ratio the median of the ratios. Places that do not fit
into `--buffer-mib` are gone through in several passes over the same memory, which is far larger than caches.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from loopclosure.aggregation.netvlad import NetVLAD, unit
from loopclosure.aggregation.reduction import Reduction
from loopclosure.compression import ChannelKL
from loopclosure.evaluation.machine import describe_machine
from loopclosure.evaluation.speed import take_turns

SHAPES = {"ResNet-152 conv5": (7, 7, 2048), "EfficientNet-Lite0 s16, the default": (14, 14, 112)}
PAPER = "paper, Table 7: 17.95 ms without KL, 13.73 ms with it (23.5 % less)"
_BLOCK = 1024  # rows of places that are widened at a time
_SAMPLES = 70  # maps: more than components


@dataclass(frozen=True)
class Variant:
    """One way to describe a map."""

    name: str
    gamma: float | None
    clusters: int = 64
    folded: bool = False
    components: int = 0


VARIANTS = (
    Variant("no KL", None),
    *(Variant(f"gamma {100 * gamma:.0f} %", gamma) for gamma in (0.0, 0.6, 0.7, 0.8, 0.9)),
    Variant("gamma 80 %, folded", 0.8, folded=True),
    Variant("gamma 80 %, K = 32", 0.8, clusters=32),
    Variant("gamma 60 %, then 64 whitened", 0.6, components=64),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--places", type=int, nargs="+", default=[1000, 10_000, 100_000])
    parser.add_argument("--rounds", type=int, default=9)
    parser.add_argument("--buffer-mib", type=int, default=1024)
    options = parser.parse_args()
    print(f"{describe_machine()}; load average {os.getloadavg()[0]:.1f}; {PAPER}")
    some = np.random.default_rng(0).standard_normal(1 << 20, dtype=np.float32)
    buffer = np.resize(some, options.buffer_mib << 18)
    for title, shape in SHAPES.items():
        widths = _describing(title, shape, options.rounds)
        _matching(widths, buffer, options)


def _describing(title: str, shape: tuple[int, int, int], rounds: int) -> dict[str, int]:
    """Time the variants and return how many numbers a place takes in each."""
    maps = np.maximum(np.random.default_rng(0).standard_normal((_SAMPLES, *shape), dtype=np.float32), 0)
    fitted = ChannelKL(gamma=0.0).fit(maps).to_arrays()
    ways = {variant.name: _way(variant, maps, fitted) for variant in VARIANTS}
    contest = take_turns({name: (lambda way=way: way(maps[:1])) for name, way in ways.items()}, 3 * rounds)
    print(f"\n{title}, {'x'.join(map(str, shape))}\n{'describing':<30}{'numbers':>9}{'ms':>9}{'x no KL':>9}")
    widths = {name: way(maps[:1]).size for name, way in ways.items()}
    for name, numbers in widths.items():
        print(f"{name:<30}{numbers:>9}{contest.median(name):>9.3f}{contest.ratio(name, 'no KL'):>9.2f}")
    return widths


def _way(variant: Variant, maps: np.ndarray, fitted: dict[str, np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    if variant.gamma is None:
        return NetVLAD(variant.clusters).fit(maps[:8]).transform
    keep = max(1, round((1 - variant.gamma) * maps.shape[-1]))
    kl = ChannelKL.from_arrays({**fitted, "basis": fitted["basis"][:keep]}, gamma=variant.gamma)
    netvlad = NetVLAD(variant.clusters).fit(kl.transform(maps[:8]))
    if variant.folded:
        return _folded(kl, netvlad)
    if not variant.components:
        return lambda some: netvlad.transform(kl.transform(some))
    reduction = Reduction(variant.components).fit(netvlad.transform(kl.transform(maps)))
    return lambda some: reduction.transform(netvlad.transform(kl.transform(some))[0])


def _folded(kl: ChannelKL, netvlad: NetVLAD) -> Callable[[np.ndarray], np.ndarray]:
    """Assign by weights that contain the basis, sum raw vectors, project the sums: K projections, not one a position.

    It is another method: a local vector gets its length 1 before the projection, because the length behind it cannot be
    had without projecting.
    """
    mean, weights = kl.mean_.astype(np.float32), netvlad.weights_ @ kl.basis_

    def describe(maps: np.ndarray) -> np.ndarray:
        local = unit(maps.reshape(-1, maps.shape[-1]) - mean)
        assignment = local @ weights.T + netvlad.bias_
        assignment = np.exp(assignment - assignment.max(1, keepdims=True))
        assignment /= assignment.sum(1, keepdims=True)
        residuals = (assignment.T @ local) @ kl.basis_.T - assignment.sum(0)[:, None] * netvlad.centres_
        return unit(unit(residuals).ravel())

    return describe


def _matching(widths: dict[str, int], buffer: np.ndarray, options: argparse.Namespace) -> None:
    """Time the comparison of a query with all places, and print what a place takes."""
    half = buffer[: len(buffer) // 4].astype(np.float16)
    kinds = {name: (numbers, buffer) for name, numbers in widths.items() if "folded" not in name}
    kinds |= {f"{name}, float16": (widths[name], half) for name in ("gamma 80 %", "gamma 60 %, then 64 whitened")}
    print(f"{'matching, ms a query':<40}{'kB a place':>12}{''.join(f'{count:>12,}' for count in options.places)}")
    columns = [
        take_turns({name: _match(*kind, count) for name, kind in kinds.items()}, options.rounds)
        for count in options.places
    ]
    for name, (numbers, memory) in kinds.items():
        cells = "".join(f"{contest.median(name):>12.3f}" for contest in columns)
        print(f"{name:<40}{numbers * memory.itemsize / 1024:>12.2f}{cells}", flush=True)


def _match(numbers: int, memory: np.ndarray, count: int) -> Callable[[], None]:
    """Return what compares a query with `count` places of so many numbers."""
    rows = min(count, len(memory) // numbers)
    places = memory[: rows * numbers].reshape(rows, numbers)
    query = places[0].astype(np.float32)
    passes = [places] * (count // rows) + [places[: count % rows]] * (count % rows > 0)

    def single() -> None:
        for part in passes:
            part @ query

    def widened() -> None:
        for part in passes:
            for first in range(0, len(part), _BLOCK):
                part[first : first + _BLOCK].astype(np.float32) @ query

    return single if memory.dtype == np.float32 else widened


if __name__ == "__main__":
    main()
