"""What every constitutive law shares: elastic moduli, invariants and checks.

Invariants are those of the three-dimensional body; in two dimensions, plane strain, the
third stretch is one. SI units.
"""

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

import torch
from jaxtyping import Float
from torch import Tensor

StateKind = Literal["b", "J"]
"""Strain variable of a law: ``b = F F^T`` of a solid, ``J = det F`` of a fluid."""


MOST = 1e20
"""Largest value of a parameter in SI units; the kernels compute in float32."""


@dataclass(frozen=True, kw_only=True)
class Solid(ABC):
    """A law of ``b = F_e F_e^T`` with the elastic moduli that a small strain measures."""

    name: ClassVar[str]
    particle_type: ClassVar[int]
    state: ClassVar[StateKind] = "b"
    cfl_limit: ClassVar[float] = 0.5
    """Largest ``sound_speed * substep_dt / dx``; measured stable to 1.0 (half is kept)."""

    density: float
    """Mass per volume at rest [kg/m^3]."""

    youngs_modulus: float
    """Small-strain Young's modulus [Pa]."""

    poissons_ratio: float
    """Small-strain Poisson's ratio, above -1 and below 1/2."""

    def __post_init__(self) -> None:
        """Reject values that no elastic body has."""
        require_positive(self, "density", "kg/m^3")
        require_positive(self, "youngs_modulus", "Pa")
        if not -1.0 < self.poissons_ratio < 0.5:
            raise ValueError(
                f"{type(self).__name__}.poissons_ratio must lie between -1 and 0.5, got "
                f"{self.poissons_ratio!r}. For a nearly incompressible body use 0.45."
            )

    @property
    def lame_constants(self) -> tuple[float, float]:
        """Small-strain Lamé constants ``(mu, lambda)`` [Pa]."""
        mu = self.youngs_modulus / (2.0 * (1.0 + self.poissons_ratio))
        return mu, 2.0 * mu * self.poissons_ratio / (1.0 - 2.0 * self.poissons_ratio)

    @property
    def sound_speed(self) -> float:
        """Speed of pressure waves at rest, the same in 3-D and plane strain [m/s]."""
        mu, lam = self.lame_constants
        return math.sqrt((lam + 2.0 * mu) / self.density)

    @abstractmethod
    def law_constants(self, dimension: int) -> tuple[float, ...]:
        """Constants of the law as the kernels take them, at most five."""

    @abstractmethod
    def energy(self, b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n"]:
        """Elastic energy per initial volume, up to a constant [Pa]."""

    @abstractmethod
    def kirchhoff_stress(self, b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n d d"]:
        """Kirchhoff stress [Pa]."""

    def return_map(
        self,
        b: Float[Tensor, "*n d d"],
        volume_correction: Float[Tensor, "*n"],
        *,
        substep_dt: float,
    ) -> tuple[Float[Tensor, "*n d d"], Float[Tensor, "*n"]]:
        """Bring a trial state back to what the material can bear; an elastic one bears all.

        Args:
            b: Trial elastic strain ``F_e F_e^T`` after a substep.
            volume_correction: Logarithm of the volume gained by plastic flow; sand alone
                uses it.
            substep_dt: Time step; a rate-dependent law alone uses it [s].

        Returns:
            Elastic strain and volume correction.
        """
        del substep_dt
        return b, volume_correction


def first_invariant(b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n"]:
    """``tr C`` of the three-dimensional body; plane strain adds the unit third stretch."""
    return b.diagonal(dim1=-2, dim2=-1).sum(-1) + (3 - b.shape[-1])


def isotropic(pressure: Float[Tensor, "*n"], like: Float[Tensor, "*n d d"]) -> Tensor:
    """``pressure * I`` in the dimension of ``like``."""
    identity = torch.eye(like.shape[-1], dtype=like.dtype, device=like.device)
    return pressure[..., None, None] * identity


def require_positive(material: Any, name: str, unit: str) -> None:
    """Reject a value that is no number above zero which the kernels bear."""
    _require(material, name, unit, above=True)


def require_not_negative(material: Any, name: str, unit: str) -> None:
    """Reject a value that is no number of at least zero which the kernels bear."""
    _require(material, name, unit, above=False)


def _require(material: Any, name: str, unit: str, *, above: bool) -> None:
    value = getattr(material, name)
    good = value > 0.0 if above else value >= 0.0
    if not (good and value <= MOST):
        raise ValueError(
            f"{type(material).__name__}.{name} must be {'>' if above else '>='} 0 {unit} "
            f"and at most {MOST:g}, got {value!r}."
        )
