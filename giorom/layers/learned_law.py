r"""A constitutive law whose constants are learned: from the strain of a sample to its stress.

One law for all materials, an isotropic elastic body that yields:

.. math::
    \tau / \rho = G\, \mathrm{dev}\, \bar b + K \frac{J^n - 1}{n}\, I, \qquad
    |G\, \mathrm{dev}\, \bar b| \le Y + M p,

with the volume ratio :math:`J`, the isochoric left Cauchy-Green tensor :math:`\bar b` of the
elastic part (determinant one) and the pressure :math:`p`. A liquid yields at once (Y = M = 0),
plasticine at Y, sand at a share M of the pressure, goop at Y too, but slowly: what exceeds Y
decays exponentially. Elastic and rigid bodies never yield. Grains resist no tension.
The exponent n says how the bulk stiffens: near 0 it is Hencky's logarithm, 1 a straight line,
near 3 the :math:`J (J - 1)` of weakly compressible fluids. Densities are one: every modulus is
divided by the density [m^2/s^2], which is all that motion shows.

Source:
    Simo, "A framework for finite strain elastoplasticity based on maximum plastic dissipation",
    Comput. Methods Appl. Mech. Eng. 66, 1988 (radial return of the isochoric tensor).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn

from giorom.state import ELASTIC, GOOP, PARTICLE_TYPE_COUNT, PLASTICINE, RIGID, SAND, WATER

SOLID = (RIGID, ELASTIC)
"""Particle types that never yield."""

START = {
    "bulk": 200.0,
    "shear": 100.0,
    "exponent": 1.0,
    "strength": 1.0,
    "friction": 0.8,
    "relaxation": 1e-3,
}
"""Constants every law starts from: moduli and strength over density [m^2/s^2] that give a wave
speed of 14 m/s and yield after a fall of a decimetre, the friction of dry sand, and the time in
which goop flows [s]."""

CONSTANTS = tuple(START)
"""Columns of the table of constants."""

USERS = {
    "bulk": (RIGID, PLASTICINE, WATER, SAND, GOOP, ELASTIC),
    "shear": (RIGID, PLASTICINE, SAND, GOOP, ELASTIC),
    "exponent": (RIGID, PLASTICINE, WATER, SAND, GOOP, ELASTIC),
    "strength": (PLASTICINE, GOOP),
    "friction": (SAND,),
    "relaxation": (GOOP,),
}
"""Materials whose motion each constant changes."""

NEWTON_STEPS = 5
"""Iterations for the trace of the isochoric tensor; its error is then below rounding."""


@dataclass(frozen=True, kw_only=True)
class Strain:
    """Elastic strain of the samples."""

    isochoric: Float[Tensor, "q d d"]
    """Isochoric elastic left Cauchy-Green tensor, determinant one."""

    volume_ratio: Float[Tensor, " q"]
    """Volume over undeformed volume."""


class LearnedLaw(nn.Module):
    """Constants of the law for every particle type, learned as logarithms.

    Args:
        dimension: Space dimension.
    """

    def __init__(self, dimension: int) -> None:
        super().__init__()
        self.dimension = dimension
        for name, value in START.items():
            start = torch.full((PARTICLE_TYPE_COUNT,), value).log()
            self.register_parameter(f"log_{name}", nn.Parameter(start))

    def rest(self, particle_type: Int[Tensor, " q"]) -> Strain:
        """The undeformed state."""
        identity = torch.eye(self.dimension, device=particle_type.device)
        count = len(particle_type)
        return Strain(
            isochoric=identity.repeat(count, 1, 1),
            volume_ratio=identity.new_ones(count),
        )

    def used(self, particle_type: Int[Tensor, " q"]) -> dict[str, Bool[Tensor, " c"]]:
        """Which entries of each parameter matter for the motion of some materials."""
        kinds = torch.arange(PARTICLE_TYPE_COUNT)
        present = torch.isin(kinds, particle_type.cpu())
        return {
            f"log_{name}": present & torch.isin(kinds, torch.tensor(users))
            for name, users in USERS.items()
        }

    def constant(self, name: str, particle_type: Int[Tensor, " q"]) -> Float[Tensor, " q"]:
        """One constant of every sample."""
        return getattr(self, f"log_{name}").exp()[particle_type]

    def table(self) -> Float[Tensor, "k c"]:
        """All constants, one row per particle type, columns as ``CONSTANTS``."""
        return torch.stack([getattr(self, f"log_{name}").exp() for name in CONSTANTS], dim=1)

    def stress(self, strain: Strain, particle_type: Int[Tensor, " q"]) -> Float[Tensor, "q d d"]:
        """Kirchhoff stress over density [m^2/s^2]."""
        pull = self._pull(strain.volume_ratio, particle_type)
        shear = self.constant("shear", particle_type)[:, None, None]
        identity = torch.eye(self.dimension, device=pull.device)
        return shear * deviator(strain.isochoric) + pull[:, None, None] * identity

    def flow(
        self,
        strain: Strain,
        gradient: Float[Tensor, "q d d"],
        particle_type: Int[Tensor, " q"],
        *,
        dt: float,
    ) -> Strain:
        """The strain after a short time: elastic trial, then return to the yield surface.

        Args:
            strain: Elastic strain before.
            gradient: Velocity gradient [1/s].
            particle_type: GNS types.
            dt: Time [s].
        """
        identity = torch.eye(self.dimension, device=gradient.device)
        growth = identity + dt * gradient
        change = determinant(growth).clamp(0.2, 5.0)
        growth = growth * change.pow(-1.0 / self.dimension)[:, None, None]
        trial = growth @ strain.isochoric @ growth.mT
        trial = 0.5 * (trial + trial.mT)
        volume = strain.volume_ratio * change
        pressure = -self._pull(volume, particle_type)
        return Strain(
            isochoric=self._returned(trial, pressure, particle_type, dt=dt), volume_ratio=volume
        )

    def _pull(
        self, volume_ratio: Float[Tensor, " q"], particle_type: Int[Tensor, " q"]
    ) -> Float[Tensor, " q"]:
        """Mean stress over density, negative under pressure; grains cannot pull [m^2/s^2]."""
        exponent = self.constant("exponent", particle_type)
        pull = self.constant("bulk", particle_type) * (volume_ratio.pow(exponent) - 1.0) / exponent
        return torch.where(particle_type == SAND, pull.clamp_max(0.0), pull)

    def _returned(
        self,
        trial: Float[Tensor, "q d d"],
        pressure: Float[Tensor, " q"],
        particle_type: Int[Tensor, " q"],
        *,
        dt: float,
    ) -> Float[Tensor, "q d d"]:
        """Shorten the deviator to what the material bears."""
        names = ("shear", "strength", "friction", "relaxation")
        constant = {name: self.constant(name, particle_type) for name in names}
        shear, bears = constant["shear"], constant["strength"]
        friction = constant["friction"] * pressure.clamp_min(0.0)
        bears = torch.where(particle_type == SAND, friction, bears)
        bears = torch.where(particle_type == WATER, torch.zeros_like(bears), bears)
        deviation = deviator(trial)
        length = deviation.square().sum(dim=(1, 2)).clamp_min(1e-12).sqrt()
        excess = (1.0 - bears / (shear * length)).clamp_min(0.0)
        slow = 1.0 - torch.exp(-dt / constant["relaxation"])
        excess = torch.where(particle_type == GOOP, excess * slow, excess)
        solid = torch.isin(particle_type, particle_type.new_tensor(SOLID))
        deviation = deviation * (1.0 - excess.masked_fill(solid, 0.0))[:, None, None]
        return with_unit_determinant(deviation)


def deviator(tensor: Float[Tensor, "q d d"]) -> Float[Tensor, "q d d"]:
    """The tensor without its mean diagonal."""
    mean = tensor.diagonal(dim1=1, dim2=2).mean(dim=1)
    return tensor - mean[:, None, None] * torch.eye(tensor.shape[1], device=tensor.device)


def determinant(tensor: Float[Tensor, "q d d"]) -> Float[Tensor, " q"]:
    """Determinants of small matrices, written out: much faster than a factorisation."""
    a, b = tensor[:, 0], tensor[:, 1]
    if tensor.shape[1] == 2:
        return a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]
    return (torch.linalg.cross(a, b) * tensor[:, 2]).sum(dim=1)


def with_unit_determinant(deviation: Float[Tensor, "q d d"]) -> Float[Tensor, "q d d"]:
    r"""Add the multiple :math:`t` of the identity that gives a deviator the determinant one.

    In 2-D :math:`t^2 = 1 + |D|^2 / 2`; in 3-D the largest root of
    :math:`t^3 - \tfrac12 |D|^2 t + \det D = 1`, by Newton's method from above.
    """
    half = 0.5 * deviation.square().sum(dim=(1, 2))
    if deviation.shape[1] == 2:
        mean = (1.0 + half).sqrt()
    else:
        rest = determinant(deviation) - 1.0
        mean = 1.0 + half.sqrt()
        for _ in range(NEWTON_STEPS):
            slope = (3.0 * mean**2 - half).clamp_min(0.1)
            mean = mean - (mean**3 - half * mean + rest) / slope
    identity = torch.eye(deviation.shape[1], device=deviation.device)
    return deviation + mean[:, None, None] * identity
