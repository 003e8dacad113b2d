"""How fast and how far a body swings: one component of its motion, and the period of that.

The component is the first principal one of the true displacements; a prediction is judged by its
part in the same component, so that both numbers speak of the same mode.
"""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float
from torch import Tensor

SHORTEST_PERIOD = 4.0
"""Shortest period that is looked for [frames]."""

LONGEST_PERIOD = 2.0
"""Longest period that is looked for, as a multiple of the frames there are."""

FINENESS = 20
"""Frequencies tried per cycle over the whole motion."""


@dataclass(frozen=True, kw_only=True)
class Swing:
    """Predicted against true swinging."""

    true_period: float
    """Period of the true motion [frames]."""

    period_ratio: float
    """Predicted over true period."""

    amplitude_ratio: float
    """Predicted over true root mean square in the component, about the mean of each."""


def compare_swings(
    predicted: Float[Tensor, "t p d"], truth: Float[Tensor, "t p d"]
) -> Swing | None:
    """Period and amplitude of a predicted motion over those of the true one.

    Returns:
        None where the true motion shows less than one period: nothing can be said about it then.
    """
    true, guess = principal_motion(predicted, truth)
    spread = float(true.std())
    if len(true) < 2 * SHORTEST_PERIOD or not spread > 0.0:
        return None
    period = dominant_period(true)
    if period > len(true) - 1:
        return None
    return Swing(
        true_period=period,
        period_ratio=dominant_period(guess) / period if float(guess.std()) > 0.0 else 0.0,
        amplitude_ratio=float(guess.std()) / spread,
    )


def principal_motion(
    predicted: Float[Tensor, "t p d"], truth: Float[Tensor, "t p d"]
) -> tuple[Float[np.ndarray, " t"], Float[np.ndarray, " t"]]:
    """True and predicted motion in the first principal component of the true displacements [m].

    Displacements are those from the first true frame; the component is that of their deviations
    from the mean over time.
    """
    start = truth[0].double()
    true = (truth.double() - start).flatten(1).cpu().numpy()
    guess = (predicted.double() - start).flatten(1).cpu().numpy()
    centred = true - true.mean(axis=0)
    in_time = np.linalg.eigh(centred @ centred.T)[1][:, -1]
    mode = in_time @ centred
    mode /= max(float(np.linalg.norm(mode)), 1e-300)
    return true @ mode, guess @ mode


def dominant_period(signal: Float[np.ndarray, " t"]) -> float:
    """Period of the sine that explains most of a signal, its mean set free [frames].

    Least squares instead of a Fourier transform: the few periods of a short motion are seldom
    whole, and the resolution of a transform would be no better than the motion is long.

    Source:
        Zechmeister and Kürster, "The generalised Lomb-Scargle periodogram", Astronomy and
        Astrophysics 496 (2009).
    """
    count = len(signal)
    lowest, highest = 1.0 / (LONGEST_PERIOD * count), 1.0 / SHORTEST_PERIOD
    trials = np.linspace(lowest, highest, max(8, round(FINENESS * count * (highest - lowest))))
    for _ in range(3):
        residues = np.array([_residue(signal, frequency) for frequency in trials])
        best, step = trials[residues.argmin()], trials[1] - trials[0]
        trials = np.linspace(max(best - step, lowest), min(best + step, highest), 21)
    return float(1.0 / best)


def _residue(signal: np.ndarray, frequency: float) -> float:
    """What is left of a signal by the best constant plus sine of a frequency."""
    phase = 2.0 * math.pi * frequency * np.arange(len(signal))
    basis = np.stack([np.ones_like(phase), np.cos(phase), np.sin(phase)], axis=1)
    coefficients, *_ = np.linalg.lstsq(basis, signal, rcond=None)
    return float(np.square(signal - basis @ coefficients).sum())
