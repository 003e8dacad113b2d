"""Start NVIDIA Warp without its complaint about a missing GPU where none is asked for."""

import os
from functools import cache


@cache
def start_warp(device: str) -> None:
    """Initialise Warp once; on the CPU its messages about drivers are not shown.

    Args:
        device: Where kernels will run.
    """
    import warp as wp

    if device != "cpu":
        wp.init()
        return
    complaints = os.dup(2)
    with open(os.devnull, "w") as nowhere:
        os.dup2(nowhere.fileno(), 2)
    try:
        wp.init()
    finally:
        os.dup2(complaints, 2)
        os.close(complaints)
