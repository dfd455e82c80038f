"""Is memory flat on a long drive? Peak of the process beyond its map after 1,000 and after 100,000 frames.

    python benchmarks/flat_memory.py [--frames 1000 100000]

A text file names a few hundred small simulated images over and over, and all that `loopclosure detect` does is done
with it, report included, each number of frames in a process of its own. What the images show does not matter, so the
input of the network is 64 x 64 pixels and loops are not verified.
"""

from __future__ import annotations

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from itertools import cycle, islice
from pathlib import Path

LIMIT_MIB = 500
VIEWS = 400
SETTINGS = {"features": {"height": 64, "width": 64}, "verification": {"mode": "none"}}


def measure(listed: Path, folder: Path) -> dict[str, float]:
    from loopclosure.config import Config
    from loopclosure.report import write_report
    from loopclosure.runs import detect_loops
    from loopclosure.store import load_arrays

    start = time.perf_counter()
    config = Config(**SETTINGS)
    run = detect_loops(listed, folder / "run", config=config, save_detector=folder / "detector")
    write_report(run)
    seconds = time.perf_counter() - start
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    descriptors = load_arrays(folder / "detector", kind="detector")[1]["traverse.map.descriptors"]
    return {
        "frames": len(run.decisions),
        "accepted": sum(decision.accepted for decision in run.decisions),
        "map_mib": descriptors.nbytes / 2**20,
        "peak_mib": peak,
        "seconds": seconds,
        **{stage: float(spent) for stage, spent in run.info["seconds"].items()},
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--frames", type=int, nargs="+", default=[1000, 100_000])
    parser.add_argument("--measure", type=Path, nargs=2, metavar=("LIST", "FOLDER"), help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measure:
        print(json.dumps(measure(*options.measure)))
        return
    beyond = []
    with tempfile.TemporaryDirectory() as temporary:
        names = rendered(Path(temporary) / "drive")
        for frames in options.frames:
            folder = Path(temporary) / str(frames)
            folder.mkdir()
            listed = folder / "images.txt"
            listed.write_text("".join(f"{name}\n" for name in islice(cycle(names), frames)))
            command = [sys.executable, __file__, "--measure", str(listed), str(folder)]
            found = json.loads(subprocess.run(command, check=True, stdout=subprocess.PIPE).stdout)
            print({name: round(value, 1) for name, value in found.items()}, flush=True)
            beyond.append(found["peak_mib"] - found["map_mib"])
    grown = beyond[-1] - beyond[0]
    verdict = "within" if grown <= LIMIT_MIB else "MORE than"
    print(f"beside the map the process grew by {grown:.0f} MiB, {verdict} the {LIMIT_MIB} MiB that are allowed")


def rendered(folder: Path) -> list[Path]:
    from loopclosure.images.simulator import SimulationSettings, simulate

    simulate(folder, SimulationSettings(frames=VIEWS, width=64, height=48, revisit=False))
    return sorted((folder / "images").iterdir())


if __name__ == "__main__":
    main()
