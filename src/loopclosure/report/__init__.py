"""Pictures for print and one self-contained page a run.

>>> from loopclosure.report import write_report
>>> write_report(run)  # doctest: +SKIP
"""

from loopclosure.report.curves import precision_recall
from loopclosure.report.matrices import similarity_matrix
from loopclosure.report.page import write_report
from loopclosure.report.pairs import Pair, judge, loop_pairs, spread
from loopclosure.report.spectrum import kl_spectrum
from loopclosure.report.style import png
from loopclosure.report.trajectory import trajectory

__all__ = [
    "Pair",
    "judge",
    "kl_spectrum",
    "loop_pairs",
    "png",
    "precision_recall",
    "similarity_matrix",
    "spread",
    "trajectory",
    "write_report",
]
