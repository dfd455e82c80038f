"""Verifier: do two images show one place? Features, matches, one camera motion, and how much of the view follows it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Literal, NamedTuple

import numpy as np

from loopclosure.errors import ConfigError, did_you_mean
from loopclosure.features.keypoints import KeypointExtractor, KeypointKind
from loopclosure.images.decode import check_image
from loopclosure.verification.geometry import ModelName, Motion, fit_geometry, relative_motion
from loopclosure.verification.local_features import LocalFeatures, compact
from loopclosure.verification.matching import mutual_matches

VerificationMode = Literal["fast", "strict"]

GRID = (16, 12)
"""Columns and rows of the cells in which inliers are looked for."""

_SIDE = 400  # pixels of the longer side in which features are sought; 640 took three times as long and found no more
_RATIO = 0.87
_UNITS = 640  # of length, along the longer side of an image: cameras differ in resolution
_THRESHOLD = 1.5  # units to the model
_STILL = 1.5  # units that a match moves at most when it belongs to the camera
_HARDLY_MOVED = 80.0  # units that a point moves at most in a few frames when it goes along with the robot
_STANDS = 0.6  # share of still matches of two drives above which the camera stands alike in both
_CREEPS = 0.9  # share of the matches with an earlier view that hardly moved, above which the robot stands or creeps


class Effort(NamedTuple):
    """What a mode spends and asks.

    Attributes
    ----------
    max_features : int
        Features an image.
    least_support : float
        See `Verification.support`.
    """

    max_features: int
    least_support: float


MODES: dict[VerificationMode, Effort] = {"fast": Effort(500, 3.0), "strict": Effort(1000, 5.0)}
"""Chosen on walks, a corridor and simulated traffic together: two different places have a support of 0.6 by chance and
up to 2.6 with like furniture. Where the same model of lorry fills half of both images it is up to 4.4, and 5.9 with the
features of `fast`, which such a pair can deceive unless the way to it decides (`Witness`)."""


@dataclass(frozen=True, eq=False)
class Verification:
    """What the geometry of a query and its match says.

    Attributes
    ----------
    verified : bool
        Whether the two images show one place. False does not say that they show two: by night, in fog and from afar
        local features fail, and a place that is seen again gives no more than two different places do.
    inliers : int
        Matches that agree with one camera motion.
    spread : float
        Share of the cells of a grid of 16 x 12 over the image that hold an inlier, 0..1; the smaller one of the two
        images. Not near 1 even for two copies of an image, because sky and road have no features.
    matches : int
        Pairs of features that are each other's nearest; the motion is sought among those that also stand out.
    model : {"fundamental", "homography"} or None
        What the inliers agree with; a homography where the scene is flat or the camera only turned.
    query_points, match_points : ndarray of float32, shape (inliers, 2)
        The inliers, pixels of each image.
    motion : Motion or None
        From the camera of the match to that of the query; None without intrinsics, or where nothing was verified.
    """

    verified: bool
    inliers: int
    spread: float
    matches: int
    model: ModelName | None
    query_points: np.ndarray = field(repr=False)
    match_points: np.ndarray = field(repr=False)
    motion: Motion | None = None

    @property
    def support(self) -> float:
        """Cells that hold an inlier, times the share of the matches that are inliers.

        A van that is ahead in both images has many inliers, but in few cells; chance spreads its inliers, but they are
        a small share of the matches.
        """
        return self.spread * GRID[0] * GRID[1] * self.inliers / max(self.matches, 1)


class Verifier:
    """Check by local features whether two images can be of one place.

    Parameters
    ----------
    mode : {"fast", "strict"}
        See `MODES`.
    keypoints : {"corners", "rootsift", "orb"}
        What is matched, see `KeypointExtractor`. RootSIFT at corners finds more of a place than at the blobs of SIFT,
        by night too, in a third of the time; where cameras differ much in scale or roll, blobs do.
    intrinsics : ndarray of float64, shape (3, 3), optional
        ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` in pixels of the images that are given, one camera for both; with it
        verified pairs get their `Motion`.
    seed : int
        Of the random samples: the same images give the same answer.

    Raises
    ------
    ConfigError
        For an unknown mode or kind of keypoints, or intrinsics of another form.

    Examples
    --------
    >>> verifier = Verifier("fast")
    >>> image = np.random.default_rng(0).integers(0, 255, (60, 80, 3), np.uint8).repeat(5, 0).repeat(5, 1)
    >>> features = verifier.features(image)
    >>> verifier.verify(features, features).verified
    True
    """

    side = _SIDE
    """Pixels to which the longer side of an image is scaled: more are not needed."""

    def __init__(
        self,
        mode: VerificationMode = "fast",
        *,
        keypoints: KeypointKind = "corners",
        intrinsics: np.ndarray | None = None,
        seed: int = 0,
    ) -> None:
        if mode not in MODES:
            raise ConfigError(f"unknown verification '{mode}'{did_you_mean(mode, MODES)}; known: {', '.join(MODES)}")
        effort = MODES[mode]
        self.mode = mode
        self.least_support = effort.least_support
        self.intrinsics = None if intrinsics is None else _checked(np.asarray(intrinsics, np.float64))
        self._seed = seed
        self._extract = KeypointExtractor(keypoints, max_features=effort.max_features, side=_SIDE)

    def features(self, image: np.ndarray) -> LocalFeatures:
        """Return the local features of one image: at most 1000, 136 bytes each for RootSIFT.

        Parameters
        ----------
        image : ndarray of uint8, shape (h, w, 3)
            RGB.

        Raises
        ------
        ImageError
            If the array is no such image.
        """
        image = check_image(image)
        return compact(self._extract(image), (image.shape[1], image.shape[0]))

    def verify(self, query: LocalFeatures, match: LocalFeatures) -> Verification:
        """Say whether one camera motion explains what the two images have in common.

        Points that stay where they are while others move belong to the camera (the rim of a fisheye lens, the bonnet,
        a date in the corner), not to the place, and do not count.

        Parameters
        ----------
        query, match : LocalFeatures
            Of this verifier.

        Returns
        -------
        Verification

        Raises
        ------
        ConfigError
            If the two are of different kinds.
        """
        if query.descriptors.shape[1] != match.descriptors.shape[1]:
            raise ConfigError(
                f"descriptors of {query.descriptors.shape[1]} and {match.descriptors.shape[1]} bytes, wanted one kind; "
                "were both made by this verifier?"
            )
        pairs, distinct = mutual_matches(query, match, ratio=_RATIO)
        left, right = query.points[pairs[:, 0]], match.points[pairs[:, 1]]
        scaled = left * (_UNITS / max(query.size)), right * (_UNITS / max(match.size))
        model, agree = fit_geometry(*(points[distinct] for points in scaled), threshold_px=_THRESHOLD, seed=self._seed)
        still = np.linalg.norm(scaled[0] - scaled[1], axis=1) < _STILL
        counted = np.full(len(pairs), True) if still.sum() > _STANDS * len(pairs) else ~still
        inliers = np.flatnonzero(distinct)[agree & counted[distinct]]
        found = Verification(
            False,
            inliers=len(inliers),
            spread=min(_spread(left[inliers], query.size), _spread(right[inliers], match.size)),
            matches=int(counted.sum()),
            model=model,
            query_points=left[inliers],
            match_points=right[inliers],
        )
        if found.support < self.least_support:
            return found
        return replace(found, verified=True, motion=self._motion(found, max(query.size)))

    def without_still(self, features: LocalFeatures, earlier: LocalFeatures) -> LocalFeatures:
        """Leave out what stays about where it was in an earlier view of the same drive, unless everything does.

        A lorry ahead grows and shrinks a little; what stands at the side of the street passes by.

        Parameters
        ----------
        features, earlier : LocalFeatures
            Of this verifier, a few frames apart.
        """
        pairs, distinct = mutual_matches(features, earlier, ratio=_RATIO)
        found = pairs[distinct]
        moved = features.points[found[:, 0]] - earlier.points[found[:, 1]]
        still = np.linalg.norm(moved, axis=1) * (_UNITS / max(features.size)) < _HARDLY_MOVED
        if features.size != earlier.size or still.sum() > _CREEPS * len(found):
            return features
        moving = np.full(len(features), True)
        moving[found[still, 0]] = False
        return LocalFeatures(features.points[moving], features.descriptors[moving], features.size)

    def _motion(self, found: Verification, side: int) -> Motion | None:
        if self.intrinsics is None:
            return None
        return relative_motion(
            found.match_points,
            found.query_points,
            self.intrinsics,
            threshold_px=_THRESHOLD * side / _UNITS,
            seed=self._seed,
        )


def cells(points: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Return which cells of the grid hold a point.

    Parameters
    ----------
    points : ndarray of float32, shape (n, 2)
        Pixels.
    size : tuple of int
        Width and height of the image, pixels.

    Returns
    -------
    ndarray of bool, shape (12, 16)
        Rows from above, columns from the left.
    """
    filled = np.zeros(GRID[::-1], bool)
    column, row = np.clip((points + 0.5) / size * GRID, 0, np.array(GRID) - 1).astype(int).T
    filled[row, column] = True
    return filled


def _spread(points: np.ndarray, size: tuple[int, int]) -> float:
    return float(cells(points, size).mean())


def _checked(camera: np.ndarray) -> np.ndarray:
    form = camera.shape == (3, 3) and np.isfinite(camera).all()
    if not form or min(camera[0, 0], camera[1, 1]) <= 0 or (camera[2] != [0, 0, 1]).any():
        raise ConfigError(
            f"found intrinsics {camera.tolist()}, wanted [[fx, 0, cx], [0, fy, cy], [0, 0, 1]] in pixels; "
            "are they transposed?"
        )
    return camera
