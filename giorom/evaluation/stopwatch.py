"""Time of each stage of a rollout."""

import time
from collections.abc import Callable
from typing import Any

import torch


class Stopwatch:
    """Adds up the time spent in wrapped functions, by stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    def timed(self, stage: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """``function`` with its time added to ``stage``; waits for the device."""
        self.seconds.setdefault(stage, 0.0)

        def measured(*arguments: Any, **options: Any) -> Any:
            synchronize()
            start = time.perf_counter()
            result = function(*arguments, **options)
            synchronize()
            self.seconds[stage] += time.perf_counter() - start
            return result

        return measured


def synchronize() -> None:
    """Wait until the GPU, if any is in use, has done its work."""
    if torch.cuda.is_available() and torch.cuda.is_initialized():
        torch.cuda.synchronize()
