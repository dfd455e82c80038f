"""Candidates to loops: does one camera motion explain what two images have in common?

    local_features.py   what is kept of an image       matching.py   features to pairs of points
    geometry.py         pairs of points to a motion    verifier.py   Verifier: all of it, and the rule
    views.py, pictures.py   what is kept of a drive    witness.py    several frames of a sequence together

>>> from loopclosure.verification import Verifier
>>> verifier = Verifier("strict")
>>> verifier.verify(verifier.features(evening), verifier.features(morning)).verified  # doctest: +SKIP
True
"""

from loopclosure.verification.geometry import Motion, fit_geometry, relative_motion
from loopclosure.verification.local_features import LocalFeatures
from loopclosure.verification.verifier import GRID, MODES, Verification, VerificationMode, Verifier, cells
from loopclosure.verification.views import Views
from loopclosure.verification.witness import Witness

__all__ = [
    "GRID",
    "MODES",
    "LocalFeatures",
    "Motion",
    "Verification",
    "VerificationMode",
    "Verifier",
    "Views",
    "Witness",
    "cells",
    "fit_geometry",
    "relative_motion",
]
