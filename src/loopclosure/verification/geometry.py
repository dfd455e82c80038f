"""Pairs of points to one camera motion that explains most of them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import cv2
import numpy as np

ModelName = Literal["fundamental", "homography"]
_CONFIDENCE, _ITERATIONS = 0.999, 1000
_LEAST_MATCHES = 8
_TURN_ALONE = 0.9  # share of the points that a turn of the camera must explain for it to have been no more than that
_PLANAR = 0.8  # a homography that explains so much of what a fundamental matrix does leaves that one undetermined


class Fit(NamedTuple):
    """A model and the matches, bool (n,), that agree with it; `model` is None where there is none."""

    model: ModelName | None
    inliers: np.ndarray


@dataclass(frozen=True, eq=False)
class Motion:
    """How the camera of the query stands to that of the match; x to the right, y down, z forward.

    Attributes
    ----------
    rotation : ndarray of float64, shape (3, 3)
        Turns the axes of the match camera into those of the query camera: a point X of the match camera is at
        ``rotation @ X + t`` of the query camera.
    direction : ndarray of float64, shape (3,), or None
        Unit vector from the match camera to the query camera, in the axes of the match camera; its length cannot be
        known from two images. None where the images differ by a turn alone, or not at all.
    """

    rotation: np.ndarray
    direction: np.ndarray | None

    @property
    def rotation_deg(self) -> float:
        """Angle between the two cameras, degrees, 0..180."""
        return float(np.degrees(np.linalg.norm(cv2.Rodrigues(self.rotation)[0])))


def fit_geometry(left: np.ndarray, right: np.ndarray, *, threshold_px: float, seed: int = 0) -> Fit:
    """Fit a fundamental matrix and a homography by MAGSAC++ (Barath et al. 2020), and choose.

    Points on one plane, and a camera that only turned, fit a homography and leave the fundamental matrix undetermined:
    a line through any two false matches then fits as well. So a homography is chosen where it explains nearly as much.

    Parameters
    ----------
    left, right : ndarray of float32, shape (n, 2)
        Matched points, pixels.
    threshold_px : float
        Greatest distance of a point to its epipolar line; to its transferred point it is twice that.
    seed : int
        Of the random samples.

    Returns
    -------
    Fit
    """
    nothing = Fit(None, np.zeros(len(left), bool))
    if len(left) < _LEAST_MATCHES:
        return nothing
    epipolar = _magsac(cv2.findFundamentalMat, left, right, threshold_px=threshold_px, seed=seed)
    planar = _magsac(cv2.findHomography, left, right, threshold_px=2 * threshold_px, seed=seed)
    if planar.sum() >= max(_PLANAR * epipolar.sum(), 1):
        return Fit("homography", planar)
    return Fit("fundamental", epipolar) if epipolar.any() else nothing


def relative_motion(
    match: np.ndarray, query: np.ndarray, camera: np.ndarray, *, threshold_px: float, seed: int = 0
) -> Motion | None:
    """Return how the camera moved between two images of which matched points are given.

    Parameters
    ----------
    match, query : ndarray of float32, shape (n, 2)
        Matched points, pixels.
    camera : ndarray of float64, shape (3, 3)
        ``[[fx, 0, cx], [0, fy, cy], [0, 0, 1]]`` in pixels.
    threshold_px : float
        As for `fit_geometry`.
    seed : int
        Of the random samples.

    Returns
    -------
    Motion or None
        None where no essential matrix fits (Nister 2004).
    """
    if len(match) < _LEAST_MATCHES:
        return None
    turned = _rotation_between(match, query, camera)
    off = np.linalg.norm(_turn(match, camera, turned) - query, axis=1)
    if np.quantile(off, _TURN_ALONE) < 2 * threshold_px:
        return Motion(turned, None)
    try:
        essential, mask = cv2.findEssentialMat(
            match, query, camera, camera, None, None, _usac(threshold_px=threshold_px, seed=seed)
        )
        _, rotation, translation, _ = cv2.recoverPose(essential, match, query, camera, mask=mask)
    except cv2.error:
        return None
    return Motion(rotation, -(rotation.T @ translation).ravel())


def _rotation_between(match: np.ndarray, query: np.ndarray, camera: np.ndarray) -> np.ndarray:
    """Return the rotation that brings the rays of one camera nearest to those of the other (Kabsch 1976)."""
    rays = [np.linalg.solve(camera, np.column_stack([points, np.ones(len(points))]).T) for points in (match, query)]
    left, right = (ray / np.linalg.norm(ray, axis=0) for ray in rays)
    u, _, vt = np.linalg.svd(right @ left.T)
    rotation: np.ndarray = u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt
    return rotation


def _turn(points: np.ndarray, camera: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return where points, pixels, go when the camera turns on the spot."""
    return cv2.perspectiveTransform(points[None].astype(float), camera @ rotation @ np.linalg.inv(camera))[0]


def _magsac(
    find: Callable[..., Any], left: np.ndarray, right: np.ndarray, *, threshold_px: float, seed: int
) -> np.ndarray:
    """Return which matches agree with the best model, bool (n,)."""
    try:
        model, mask = find(left, right, _usac(threshold_px=threshold_px, seed=seed))
    except cv2.error:  # OpenCV 5 asserts that it found a model
        model = None
    return np.zeros(len(left), bool) if model is None else mask.ravel() > 0


def _usac(*, threshold_px: float, seed: int) -> cv2.UsacParams:
    settings = cv2.UsacParams()
    settings.threshold = threshold_px
    settings.confidence = _CONFIDENCE
    settings.maxIterations = _ITERATIONS
    settings.randomGeneratorState = seed
    settings.score = cv2.SCORE_METHOD_MAGSAC
    settings.loMethod = cv2.LOCAL_OPTIM_SIGMA
    settings.loIterations, settings.loSampleSize = 10, 50
    settings.final_polisher = cv2.MAGSAC
    return settings
