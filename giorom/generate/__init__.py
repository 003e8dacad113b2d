"""Make a data set: many scenes, simulated side by side, each finished one kept at once.

``dataset`` says what is missing and puts the parts together, ``trajectory`` makes one part,
``pool`` and ``cluster`` are two ways to make many, ``room`` refuses what cannot fit.
"""

from giorom.generate.cluster import Cluster
from giorom.generate.dataset import generate
from giorom.generate.trajectory import SCENES_PER_SEED

__all__ = ["SCENES_PER_SEED", "Cluster", "generate"]
