"""Visual loop-closure detection: is the robot back at a place that it has seen?

The data flow is the folder list::

    images/         folders, text files of paths, videos, the simulator      -> uint8 RGB
    features/       backbones                                                -> feature maps
    compression/    Karhunen-Loeve transform                                 -> smaller feature maps
    aggregation/    NetVLAD, layout, running mean                            -> one descriptor a frame
    matching/       map, sequences                                           -> scores of candidates
    verification/   local features, camera motion                            -> support of candidates
    decision.py     the odds of a loop                                       -> decisions
    detect.py       LoopDetector: all of it, one frame at a time
    evaluation/     truth and metrics        report/  pictures and pages     cli/  the commands

`methods` is the table of systems that can be run, `config` holds every setting, `records` what travels between
stages. Importing the package loads none of the stages.
"""

from __future__ import annotations

import importlib
import logging
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from loopclosure.config import Config as Config
    from loopclosure.detect import LoopDetector as LoopDetector
    from loopclosure.errors import LoopClosureError as LoopClosureError
    from loopclosure.images.sequence import ImageSequence as ImageSequence
    from loopclosure.records import Decision as Decision
    from loopclosure.records import Reason as Reason

__version__ = "0.1.0"

_EXPORTS = {
    "Config": "loopclosure.config",
    "Decision": "loopclosure.records",
    "ImageSequence": "loopclosure.images.sequence",
    "LoopClosureError": "loopclosure.errors",
    "LoopDetector": "loopclosure.detect",
    "Reason": "loopclosure.records",
}

__all__ = sorted([*_EXPORTS, "__version__"])

logging.getLogger(__name__).addHandler(logging.NullHandler())


def __getattr__(name: str) -> Any:
    if name in _EXPORTS:
        return getattr(importlib.import_module(_EXPORTS[name]), name)
    raise AttributeError(f"module 'loopclosure' has no attribute '{name}'")


def __dir__() -> list[str]:
    return sorted([*globals(), *_EXPORTS])
