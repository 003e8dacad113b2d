r"""The fluid: it resists a change of volume only. SI units."""

import math
from dataclasses import dataclass
from typing import ClassVar

from jaxtyping import Float
from torch import Tensor

from giorom.mpm.materials.base import StateKind, require_positive
from giorom.state import WATER


@dataclass(frozen=True, kw_only=True)
class WeaklyCompressibleFluid:
    r"""Inviscid fluid that resists a change of volume only.

    .. math::
        \tau = K J (J - 1) I, \qquad \Psi = \frac{K}{2} (J - 1)^2.

    For nearly constant volume take ``sqrt(bulk_modulus / density)`` ten times the fastest
    motion. Tension is resisted too (``J > 1`` pulls).

    Source:
        arXiv:2407.03925v2, equation 24.
    """

    name: ClassVar[str] = "weakly_compressible_fluid"
    particle_type: ClassVar[int] = WATER
    state: ClassVar[StateKind] = "J"
    cfl_limit: ClassVar[float] = 0.3
    """Largest ``sound_speed * substep_dt / dx``; measured safe to 0.4."""

    density: float
    """Mass per volume at rest [kg/m^3]."""

    bulk_modulus: float
    """Stiffness ``K`` against a change of volume [Pa]."""

    def __post_init__(self) -> None:
        """Reject values that no fluid has."""
        require_positive(self, "density", "kg/m^3")
        require_positive(self, "bulk_modulus", "Pa")

    def law_constants(self, dimension: int) -> tuple[float]:
        """Constants of the law for the kernels: ``(K [Pa],)``."""
        del dimension
        return (self.bulk_modulus,)

    @property
    def sound_speed(self) -> float:
        """Speed of pressure waves at rest [m/s]."""
        return math.sqrt(self.bulk_modulus / self.density)

    def energy(self, volume_ratio: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Elastic energy per initial volume of ``J`` [Pa]."""
        return 0.5 * self.bulk_modulus * (volume_ratio - 1.0) ** 2

    def kirchhoff_stress(self, volume_ratio: Float[Tensor, "*n"]) -> Float[Tensor, "*n"]:
        """Isotropic Kirchhoff stress ``K J (J - 1)`` of ``J`` [Pa]."""
        return self.bulk_modulus * volume_ratio * (volume_ratio - 1.0)
