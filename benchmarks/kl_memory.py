"""Peak memory and seconds of fitting the KL transform on maps that fill most of the allowed memory.

Each case runs in a process of its own, and its peak includes the interpreter and the input.
Run ``python benchmarks/kl_memory.py``; OMP_NUM_THREADS sets the threads.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import subprocess
import sys
import time

CASES = ("channel", "flat", "channel-stream", "flat-stream")
LIMIT_MIB = 2048


def measure(case: str, images: int, side: int, channels: int, gamma: float) -> dict[str, float]:
    import numpy as np

    from loopclosure.compression import build

    rng = np.random.default_rng(0)
    maps = np.empty((images, side, side, channels), np.float32)
    for image in maps:  # image by image, so that making them needs no second copy
        image[...] = np.maximum(rng.standard_normal(image.shape, np.float32), 0)
    reading, _, stream = case.partition("-")
    kl = build(reading, gamma=gamma)
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    start = time.perf_counter()
    if stream:
        for first in range(0, images, 100):
            kl.partial_fit(maps[first : first + 100])
    else:
        kl.fit(maps)
    assert len(kl.basis_)  # a stream solves its eigenproblem only now
    fitted = time.perf_counter()
    kl.transform(maps[:100])
    transformed = time.perf_counter()
    return {
        "input_mib": maps.nbytes / 2**20,
        "before_mib": before / 1024,
        "peak_mib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "fit_s": fitted - start,
        "transform_ms_an_image": (transformed - fitted) * 10,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--images", type=int, default=2000)
    parser.add_argument("--side", type=int, default=7, help="height and width of the maps")
    parser.add_argument("--channels", type=int, default=2048)
    parser.add_argument("--gamma", type=float, default=0.8)
    parser.add_argument("--case", choices=CASES, help="measure this one here and print JSON")
    args = parser.parse_args()
    if args.case:
        print(json.dumps(measure(args.case, args.images, args.side, args.channels, args.gamma)))
        return 0
    threads = os.environ.get("OMP_NUM_THREADS", f"all of {os.cpu_count()}")
    print(f"{processor()}, Python {platform.python_version()}, threads: {threads}")
    print(f"{args.images} maps of {args.side} x {args.side} x {args.channels} float32, gamma {args.gamma}")
    worst = 0.0
    for case in CASES:
        command = [sys.executable, __file__, *sys.argv[1:], "--case", case]
        result = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
        worst = max(worst, result["peak_mib"])
        print(
            f"{case:15} peak {result['peak_mib']:6.0f} MiB (input {result['input_mib']:.0f}, "
            f"before fit {result['before_mib']:.0f}), fit {result['fit_s']:6.1f} s, "
            f"transform {result['transform_ms_an_image']:.2f} ms an image in batches of 100"
        )
    print(f"limit {LIMIT_MIB} MiB: {'kept' if worst <= LIMIT_MIB else 'BROKEN'}")
    return int(worst > LIMIT_MIB)


def processor() -> str:
    try:
        with open("/proc/cpuinfo", encoding="utf-8") as file:
            return next(line.partition(":")[2].strip() for line in file if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor() or platform.machine()


if __name__ == "__main__":
    sys.exit(main())
