"""Order names as people count: frame 2 before frame 10."""

import re
from pathlib import Path
from typing import Any

__all__ = ["natural_key"]


def natural_key(path: Path) -> tuple[Any, ...]:
    """Sort key under which the numbers in a name count as numbers.

    Args:
        path: A file or folder.

    Returns:
        Its name, cut at its numbers.
    """
    parts = re.split(r"(\d+)", path.name)
    return (*((int(part[:18]), part) if part.isdecimal() else (0, part) for part in parts),)
