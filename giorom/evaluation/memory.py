"""How much memory a piece of work needs on top of what is there before it.

On a GPU the allocator of PyTorch knows. On a CPU nothing counts the tensors, so that the operating
system is asked: the high-water mark of the process is set back before the work and read after it.
What an earlier piece of work has given back may still belong to the process and would be used
again without being counted, so that a number to be printed is measured in a process that has done
nothing before (``fresh_process.py``).
"""

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch

STATUS, MARKS = Path("/proc/self/status"), Path("/proc/self/clear_refs")
"""Where Linux says how large a process is, and sets its high-water mark back."""

HIGH_WATER = "5"
"""What has to be written to ``MARKS``."""


def peak_memory(work: Callable[[], Any], *, device: torch.device | str) -> tuple[Any, int]:
    """Do some work and measure the most memory it holds at a time.

    Args:
        work: What to do.
        device: Where its tensors are.

    Returns:
        The result of the work, and bytes beyond those in use before it.
    """
    if torch.device(device).type == "cuda":
        torch.cuda.synchronize()
        torch.cuda.reset_peak_memory_stats()
        before = torch.cuda.memory_allocated()
        result = work()
        torch.cuda.synchronize()
        return result, torch.cuda.max_memory_allocated() - before
    before = _resident_after_reset()
    result = work()
    return result, max(0, _high_water() - before)


def _resident_after_reset() -> int:
    """Bytes in use, from which the high-water mark now starts anew."""
    if not MARKS.exists():
        return _high_water()
    MARKS.write_text(HIGH_WATER)
    return _from_status("VmRSS")


def _high_water() -> int:
    """Most bytes in use since the mark was set back; elsewhere than on Linux since the start."""
    if STATUS.exists():
        return _from_status("VmHWM")
    import resource

    found = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return found if sys.platform == "darwin" else 1024 * found


def _from_status(name: str) -> int:
    """An entry of the process' status, in bytes."""
    for line in STATUS.read_text(encoding="utf-8").splitlines():
        if line.startswith(f"{name}:"):
            return 1024 * int(line.split()[1])
    raise OSError(f"{STATUS} has no entry {name}, so that memory cannot be measured here.")
