"""Constitutive laws: what stress a deformation causes.

Every law is isotropic and gives the Kirchhoff stress ``tau = J sigma = P F^T`` (force on
the initial volume), so it depends on ``b = F F^T`` (solids) or ``J = det F`` (fluids) alone.
The float64 reference here is what the simulator's kernels are tested against.

Two dimensions mean plane strain: the third stretch is one (``F_zz = 1``), so invariants are
those of the three-dimensional body and the same constants hold in both dimensions.

SI units: Pa, kg/m^3. This module needs torch alone.
"""

import math
from dataclasses import asdict, dataclass, fields
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.state import ELASTIC, WATER


@dataclass(frozen=True, kw_only=True)
class StableNeoHookean:
    r"""Stable neo-Hookean solid: stress free at rest, finite when squeezed or inverted.

    .. math::
        \Psi = \frac{\mu_S}{2}(I_C - 3) + \frac{\lambda_S}{2}(J - a)^2
               - \frac{\mu_S}{2}\log(I_C + 1), \qquad
        a = 1 + \frac{3 \mu_S}{4 \lambda_S}.

    Expanded about rest this law has the Lamé constants ``3/4 mu_S`` and
    ``lambda_S - 5/8 mu_S``. So that ``youngs_modulus`` and ``poissons_ratio`` are the moduli
    that a small strain measures, the constants of the law are ``mu_S = 4/3 mu`` and
    ``lambda_S = lambda + 5/6 mu``.

    Source:
        arXiv:2407.03925v2, equations 22-23; Smith, de Goes and Kim, "Stable Neo-Hookean
        Flesh Simulation", ACM TOG 2018, for ``a`` and the change of constants.
    """

    name: ClassVar[str] = "stable_neo_hookean"
    particle_type: ClassVar[int] = ELASTIC
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
        _require_positive(self, "density", "kg/m^3")
        _require_positive(self, "youngs_modulus", "Pa")
        if not -1.0 < self.poissons_ratio < 0.5:
            raise ValueError(
                f"StableNeoHookean.poissons_ratio must lie between -1 and 0.5, got "
                f"{self.poissons_ratio!r}. For a nearly incompressible body use 0.45."
            )

    @property
    def lame_constants(self) -> tuple[float, float]:
        """Small-strain Lamé constants ``(mu, lambda)`` [Pa]."""
        mu = self.youngs_modulus / (2.0 * (1.0 + self.poissons_ratio))
        return mu, 2.0 * mu * self.poissons_ratio / (1.0 - 2.0 * self.poissons_ratio)

    @property
    def law_constants(self) -> tuple[float, float, float]:
        """Constants ``(mu_S [Pa], lambda_S [Pa], a)`` of the energy."""
        mu, lam = self.lame_constants
        mu_s, lam_s = 4.0 / 3.0 * mu, lam + 5.0 / 6.0 * mu
        return mu_s, lam_s, 1.0 + 0.75 * mu_s / lam_s

    @property
    def sound_speed(self) -> float:
        """Speed of pressure waves at rest, the same in 3-D and plane strain [m/s]."""
        mu, lam = self.lame_constants
        return math.sqrt((lam + 2.0 * mu) / self.density)

    def energy(self, b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n"]:
        """Elastic energy per initial volume of ``b = F F^T``, up to a constant [Pa]."""
        mu, lam, a = self.law_constants
        invariant = _first_invariant(b)
        volume_ratio = torch.linalg.det(b).sqrt()
        shear = invariant - 3.0 - torch.log(invariant + 1.0)
        return 0.5 * mu * shear + 0.5 * lam * (volume_ratio - a) ** 2

    def kirchhoff_stress(self, b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n d d"]:
        r"""Kirchhoff stress of ``b = F F^T`` [Pa].

        .. math::
            \tau = \mu_S \Big(1 - \frac{1}{I_C + 1}\Big) b + \lambda_S J (J - a) I
        """
        mu, lam, a = self.law_constants
        shear = mu * (1.0 - 1.0 / (_first_invariant(b) + 1.0))
        volume_ratio = torch.linalg.det(b).sqrt()
        pressure = lam * volume_ratio * (volume_ratio - a)
        identity = torch.eye(b.shape[-1], dtype=b.dtype, device=b.device)
        return shear[..., None, None] * b + pressure[..., None, None] * identity


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
    cfl_limit: ClassVar[float] = 0.3
    """Largest ``sound_speed * substep_dt / dx``; measured safe to 0.4."""

    density: float
    """Mass per volume at rest [kg/m^3]."""

    bulk_modulus: float
    """Stiffness ``K`` against a change of volume [Pa]."""

    def __post_init__(self) -> None:
        """Reject values that no fluid has."""
        _require_positive(self, "density", "kg/m^3")
        _require_positive(self, "bulk_modulus", "Pa")

    @property
    def law_constants(self) -> tuple[float, float, float]:
        """Constants of the law for the kernels: ``(K [Pa], 0, 0)``."""
        return self.bulk_modulus, 0.0, 0.0

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


Material = StableNeoHookean | WeaklyCompressibleFluid

MATERIALS: dict[str, type[StableNeoHookean] | type[WeaklyCompressibleFluid]] = {
    law.name: law for law in (StableNeoHookean, WeaklyCompressibleFluid)
}
"""Every material by the name it has in YAML."""


def make_material(name: str, parameters: dict[str, float]) -> Material:
    """Build a material from its YAML name and parameters.

    Args:
        name: A key of ``MATERIALS``.
        parameters: Field values of that material, SI.

    Returns:
        The material.

    Raises:
        ValueError: If the name or a parameter is unknown, missing or out of range.
    """
    if name not in MATERIALS:
        raise ValueError(f"there is no material {name!r}. Materials: {', '.join(MATERIALS)}.")
    wanted = [field.name for field in fields(MATERIALS[name])]
    if sorted(parameters) != sorted(wanted):
        raise ValueError(
            f"material {name} takes exactly the parameters {', '.join(wanted)}, got "
            f"{', '.join(parameters) or 'none'}. Add the missing and drop the others."
        )
    return MATERIALS[name](**parameters)


def material_attributes(material: Material) -> dict[str, float | str]:
    """Name and parameters of a material as JSON values, keys as in YAML."""
    return {"material": material.name, **asdict(material)}


def _first_invariant(b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n"]:
    """``tr C`` of the three-dimensional body; plane strain adds the unit third stretch."""
    return b.diagonal(dim1=-2, dim2=-1).sum(-1) + (3 - b.shape[-1])


def _require_positive(material: Material, name: str, unit: str) -> None:
    value = getattr(material, name)
    if not (value > 0.0 and math.isfinite(value)):
        raise ValueError(f"{type(material).__name__}.{name} must be > 0 {unit}, got {value!r}.")
