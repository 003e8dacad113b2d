"""The tables and figures of the paper, and what it lacks: one module each, found by its name.

Every module has a ``TITLE`` and ``run(study) -> Result``. What they share (data sets, trained
models, scores) is made by ``study.py`` and kept, so that two of them never make it twice.
"""

from giorom.reproduce.report import Result
from giorom.reproduce.scale import SCALES, Scale, SystemScale
from giorom.reproduce.study import Study, Trial
from giorom.reproduce.tuning import tuned

IDS = (
    "table1",
    "table2",
    "table3",
    "table4",
    "table5",
    "table7",
    "table8",
    "table9",
    "table10",
    "table11",
    "table12",
    "table13",
    "table14",
    "rom",
    "latent",
    "figure3",
    "figure5a",
    "figure6",
    "figure7",
    "figure8",
    "figure9",
    "peers",
)
"""Names of the modules, in the order in which ``all`` runs them."""

__all__ = ["IDS", "SCALES", "Result", "Scale", "Study", "SystemScale", "Trial", "tuned"]
