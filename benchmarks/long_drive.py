"""Memory and time of a long online drive: 5,000 frames through `LoopDetector.add`.

    python benchmarks/long_drive.py [--frames 5000]

Prints what the process grew by beside what the map holds, and the time of one `add` with 500 frames and with all frames
in the map: medians of alternating runs, two detectors take the same frames in turn.
"""

import argparse
import ctypes
import gc
import os
import platform
import tempfile
import time

import numpy as np
import torch

from loopclosure import LoopDetector
from loopclosure.images.simulator import Drive, SimulationSettings

SHORT, RUNS = 500, 100


def resident_mb():
    """Memory of this process that is in RAM, megabytes, without what was freed but not given back."""
    gc.collect()
    ctypes.CDLL(None).malloc_trim(0)
    with open("/proc/self/statm") as file:
        return int(file.read().split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6


def timed_add(detector, image):
    start = time.perf_counter()
    detector.add(image)
    return 1000 * (time.perf_counter() - start)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=5000)
    frames = parser.parse_args().frames
    views = [frame.image for frame in Drive(SimulationSettings(frames=400))]
    images = [views[i % len(views)] for i in range(frames)]
    print(f"{platform.processor() or platform.machine()}, {torch.get_num_threads()} threads, {frames} frames")

    detector = LoopDetector()
    with tempfile.TemporaryDirectory() as folder:
        for image in images[:SHORT]:
            detector.add(image)
        detector.save(folder)
        short = LoopDetector.load(folder)
    before_mb, before_map = resident_mb(), detector.map_bytes
    for image in images[SHORT:]:
        detector.add(image)
    grown_mb, map_mb = resident_mb() - before_mb, (detector.map_bytes - before_map) / 1e6
    print(f"from frame {SHORT} to {frames}: process {grown_mb:+.1f} MB, descriptors {map_mb:+.1f} MB")
    print(f"beside the descriptors: {1000 * (grown_mb - map_mb) / (frames - SHORT):.2f} kB a frame")

    pairs = [(timed_add(short, image), timed_add(detector, image)) for image in images[:RUNS]]
    at_short, at_long = np.median(pairs, axis=0)
    ratio = np.median([long / short_ms for short_ms, long in pairs])
    print(f"one add: {at_short:.1f} ms at frame {SHORT}, {at_long:.1f} ms at frame {frames}; ratio {ratio:.2f}")


if __name__ == "__main__":
    main()
