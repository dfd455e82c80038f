"""Truth and metrics, in plain numpy: what a published number means, and how far it can be trusted.

>>> from loopclosure.evaluation import evaluate_run
>>> metrics, curve = evaluate_run("RUN", "truth.csv", tolerance=2)  # doctest: +SKIP
"""

from loopclosure.evaluation.log import LOOPS_FILE, LOOPS_HEADER, LoopLog, read_loops
from loopclosure.evaluation.metrics import (
    PrecisionRecall,
    Reports,
    average_precision,
    bootstrap_interval,
    precision_recall,
    recall_at_precision,
)
from loopclosure.evaluation.pairs import recall_at_n
from loopclosure.evaluation.protocol import Evaluation, evaluate
from loopclosure.evaluation.runs import evaluate_run
from loopclosure.evaluation.truth import Truth, load_truth

__all__ = [
    "LOOPS_FILE",
    "LOOPS_HEADER",
    "Evaluation",
    "LoopLog",
    "PrecisionRecall",
    "Reports",
    "Truth",
    "average_precision",
    "bootstrap_interval",
    "evaluate",
    "evaluate_run",
    "load_truth",
    "precision_recall",
    "read_loops",
    "recall_at_n",
    "recall_at_precision",
]
