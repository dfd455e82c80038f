"""True pairs of two traverses, as the text of a truth file."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from loopclosure.errors import TruthError

MAX_POSITION_BYTES = 1 << 28
_EARTH_M = 6_371_008.8  # mean radius
_MOST_FRAMES_OFF = 0.01
_log = logging.getLogger(__name__)


def pairs_by_number(queries: int, references: int) -> str:
    """Return the truth of two traverses that were aligned frame by frame.

    Raises
    ------
    TruthError
        If they have different lengths.

    Examples
    --------
    >>> print(pairs_by_number(2, 2), end="")
    query,match
    0,0
    1,1
    """
    if queries != references:
        raise TruthError(
            f"the traverses have {queries} and {references} frames, wanted equally many: frames with the same number "
            "show one place; was one of them cut short, or thinned out in another way?"
        )
    return _text(np.repeat(np.arange(queries), 2).reshape(-1, 2))


def pairs_by_position(queries: Path, references: Path, *, frames: tuple[int, int], radius_m: float) -> str:
    """Return the truth of two traverses whose frames have a position each.

    Parameters
    ----------
    queries, references : pathlib.Path
        Text files of ``latitude,longitude`` in degrees, one line a frame.
    frames : tuple of two int
        Number of query and of reference frames.
    radius_m : float
        Frames within this distance show one place, metres.

    Raises
    ------
    TruthError
        If a file holds no positions, or another number of them than there are frames.

    Notes
    -----
    Degrees become metres on a plane that touches the Earth (as a sphere) at the first position; over the few
    kilometres of a drive this is off by less than GPS is.
    """
    degrees = [_read(file, count) for file, count in zip((queries, references), frames, strict=True)]
    plane = [_on_plane(positions, degrees[0][0]) for positions in degrees]
    near = cKDTree(plane[0]).query_ball_tree(cKDTree(plane[1]), radius_m)
    pairs = [(query, match) for query, matches in enumerate(near) for match in sorted(matches)]
    return _text(np.array(pairs, dtype=np.int64).reshape(-1, 2))


def _read(file: Path, frames: int) -> np.ndarray:
    if file.stat().st_size > MAX_POSITION_BYTES:
        raise TruthError(f"{file} is larger than {MAX_POSITION_BYTES} bytes: it is no list of positions")
    try:
        positions = np.loadtxt(file, delimiter=",", ndmin=2)
    except ValueError as error:
        raise TruthError(f"{file}: {error}; wanted latitude,longitude on each line") from None
    if positions.shape[1:] != (2,) or not (np.abs(positions) <= (90, 180)).all() or not len(positions):
        raise TruthError(f"{file} holds no list of latitude,longitude in degrees")
    off = frames - len(positions)
    if abs(off) > _MOST_FRAMES_OFF * frames:
        raise TruthError(f"{file} has {len(positions)} positions for {frames} frames: was the video cut short?")
    if off:
        _log.warning("%s has %d positions for %d frames; the last is taken for the rest", file, len(positions), frames)
    return positions[np.minimum(np.arange(frames), len(positions) - 1)]


def _on_plane(degrees: np.ndarray, origin: np.ndarray) -> np.ndarray:
    north, east = (np.radians(degrees - origin) * _EARTH_M).T
    return np.column_stack([east * np.cos(np.radians(origin[0])), north])


def _text(pairs: np.ndarray) -> str:
    return "query,match\n" + "".join(f"{query},{match}\n" for query, match in pairs.tolist())
