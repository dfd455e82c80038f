"""Pictures and decisions made by hand."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np

from loopclosure.records import Decision, Reason


def draw_image(number: int, *, width: int = 480, height: int = 270) -> np.ndarray:
    """A picture that no other number has."""
    rng = np.random.default_rng(number)
    image = cv2.resize(rng.integers(0, 256, (9, 16, 3), np.uint8), (width, height), interpolation=cv2.INTER_CUBIC)
    return cv2.putText(image, str(number), (20, height // 2), cv2.FONT_HERSHEY_SIMPLEX, 3, (255, 255, 255), 8)


def write_images(folder: Path, count: int) -> Path:
    folder.mkdir(parents=True)
    for number in range(count):
        cv2.imwrite(str(folder / f"{number:04}.jpg"), draw_image(number)[..., ::-1])
    return folder


def decide(query: int, match: int | None, score: float | None, *, accepted: bool = False) -> Decision:
    if match is None:
        return Decision(query, None, None, False, None, Reason.TOO_RECENT)
    return Decision(query, match, score, accepted, None, Reason.ACCEPTED if accepted else Reason.BELOW_THRESHOLD)
