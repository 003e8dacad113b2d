"""Forecast a motion in a latent space, from the first frames and without its particles.

What competes with the whole pipeline (samples stepped, all particles recovered), not with a part of
it: a *coded field* describes any frame by a short code, and an ordinary differential equation of
the code is learned and integrated.
"""

from giorom.forecasters.coral import CoralConfig, CoralField
from giorom.forecasters.dino import DinoConfig, DinoField
from giorom.forecasters.dynamics import DynamicsConfig, LatentDynamics
from giorom.forecasters.forecaster import ForecasterConfig, LatentForecaster
from giorom.forecasters.motions import Motions, gather_motions
from giorom.forecasters.training import ForecasterTrainingConfig, train_forecaster

__all__ = [
    "CoralConfig",
    "CoralField",
    "DinoConfig",
    "DinoField",
    "DynamicsConfig",
    "ForecasterConfig",
    "ForecasterTrainingConfig",
    "LatentDynamics",
    "LatentForecaster",
    "Motions",
    "gather_motions",
    "train_forecaster",
]
