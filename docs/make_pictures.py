"""Make the picture of the README from a demo run.

python docs/make_pictures.py demo
"""

import io
import sys
from pathlib import Path

from PIL import Image

from loopclosure import Decision, ImageSequence, Reason
from loopclosure.evaluation import load_truth, read_loops
from loopclosure.report import judge, loop_pairs, png, spread


def main():
    run = Path(sys.argv[1])
    log = read_loops(run)
    truth = load_truth(run / "drive" / "truth.csv", frames=(len(log), None), exclude_recent=30)
    decisions = [
        Decision(query, None if match < 0 else int(match), float(score), bool(accepted), None, Reason(reason))
        for query, (match, score, accepted, reason) in enumerate(
            zip(log.match, log.score, log.accepted, log.reason, strict=True)
        )
    ]
    loops = [pair for pair in judge(decisions, truth) if pair.accepted]
    images = ImageSequence(run / "drive" / "images")
    figure = Image.open(io.BytesIO(png(loop_pairs(spread(loops, 4, apart=25), images, images)))).convert("RGB")
    figure.thumbnail((1200, 1200))
    picture = Path(__file__).parent / "images" / "loops.jpg"
    picture.parent.mkdir(exist_ok=True)
    figure.save(picture, quality=88)


if __name__ == "__main__":
    main()
