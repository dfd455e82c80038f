"""The TensorBoard log, or nothing."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

LOG = "log"
_log = logging.getLogger(__name__)


Board = Callable[[int, Sequence[float], Mapping[str, Any]], None]
"""``board(epoch, losses, row)``: the losses of a round's steps, and the last row of the history."""


@contextmanager
def open_board(folder: Path) -> Iterator[Board]:
    """Give a board that writes to ``folder/log``; without TensorBoard it writes nothing, and a warning says so."""
    try:
        from torch.utils.tensorboard import SummaryWriter
    except ImportError:
        _log.warning("no TensorBoard log is written; pip install 'loopclosure[train]' for it")
        yield lambda *_: None
        return
    with SummaryWriter(str(folder / LOG)) as writer:

        def write(epoch: int, losses: Sequence[float], row: Mapping[str, Any]) -> None:
            if losses:
                writer.add_scalar("loss/training", sum(losses) / len(losses), epoch + 1)
            for name, value in row.items():
                if value is not None and name != "epoch" and row["epoch"] == epoch + 1:
                    writer.add_scalar(f"held out/{name}", value, epoch + 1)

        yield write
