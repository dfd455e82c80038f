"""The machine on which a time was measured: a time without it means nothing."""

from __future__ import annotations

import os
import platform
from pathlib import Path

_CPU_INFO = Path("/proc/cpuinfo")


def describe_machine() -> str:
    """Return the processor, its cores, the threads that PyTorch uses, and the system, in a line."""
    import torch

    cores, threads = os.cpu_count() or 1, torch.get_num_threads()
    return (
        f"{_processor()}, {cores} core{'s' * (cores > 1)}; PyTorch {torch.__version__}, "
        f"{threads} thread{'s' * (threads > 1)}; {platform.system()} {platform.machine()}"
    )


def _processor() -> str:
    """Return the name that the processor gives itself; `platform` does not know it on Linux."""
    try:
        lines = _CPU_INFO.read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:
        lines = []
    named = (line.partition(":")[2].strip() for line in lines if line.startswith("model name"))
    return next(filter(None, named), "") or platform.processor() or "unnamed processor"
