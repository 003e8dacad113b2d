"""What a measurement was made with: the machine and the versions."""

import importlib.metadata
import os
import platform
from pathlib import Path
from typing import Any

from giorom.version import __version__

PACKAGES = ("torch", "warp-lang", "numpy", "h5py")
"""Packages whose version can change a speed."""


def describe_machine() -> dict[str, Any]:
    """Processor, cores, load and versions, as JSON values."""
    return {
        "processor": _processor(),
        "cores": os.cpu_count(),
        "load_average": [round(value, 2) for value in os.getloadavg()],
        "system": f"{platform.system()} {platform.machine()}",
        "versions": {
            "giorom": __version__,
            "python": platform.python_version(),
            **{name: _version(name) for name in PACKAGES},
        },
    }


def _processor() -> str:
    """Model name of the processor, where the system tells it."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.processor()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor()


def _version(name: str) -> str | None:
    try:
        return importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return None
