r"""Plastic solids: Hencky elasticity up to a yield surface, then flow. SI units."""

from dataclasses import dataclass
from typing import ClassVar

import torch
from jaxtyping import Float
from torch import Tensor

from giorom.mpm.materials.base import Solid, require_not_negative, require_positive
from giorom.mpm.return_maps import (
    cone_slope,
    from_principal_strains,
    principal_stretches,
    sand_map,
    viscoplastic_map,
)
from giorom.state import GOOP, PLASTICINE, SAND


@dataclass(frozen=True, kw_only=True)
class Hencky(Solid):
    r"""Elasticity of the principal logarithmic strains ``e_i = ln s_i``.

    .. math::
        \Psi = \mu |e|^2 + \frac{\lambda}{2} (tr\, e)^2, \qquad
        \tau = \sum_i (2 \mu e_i + \lambda\, tr\, e)\, n_i n_i^T.
    """

    def energy(self, b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n"]:
        """Elastic energy per initial volume of ``b = F_e F_e^T`` [Pa]."""
        mu, lam = self.lame_constants
        strain = principal_stretches(b)[0].log()
        return mu * (strain**2).sum(-1) + 0.5 * lam * strain.sum(-1) ** 2

    def kirchhoff_stress(self, b: Float[Tensor, "*n d d"]) -> Float[Tensor, "*n d d"]:
        """Kirchhoff stress of ``b = F_e F_e^T`` [Pa]."""
        mu, lam = self.lame_constants
        stretch, axes = principal_stretches(b)
        strain = stretch.log()
        principal = 2.0 * mu * strain + lam * strain.sum(-1, keepdim=True)
        return (axes * principal[..., None, :]) @ axes.mT


@dataclass(frozen=True, kw_only=True)
class _Yielding(Hencky):
    """A Hencky body whose deviator flows above a yield stress."""

    yield_stress: float
    """Deviatoric stress at which it flows, ``|dev tau| = sqrt(s : s)`` [Pa]; in uniaxial
    tension that is a stress of ``sqrt(3/2)`` times as much, in shear ``1/sqrt(2)`` times."""

    def __post_init__(self) -> None:
        """Reject a yield stress that is not positive."""
        super().__post_init__()
        require_positive(self, "yield_stress", "Pa")

    @property
    def yield_strain(self) -> float:
        """``|dev e|`` at yield."""
        return self.yield_stress / (2.0 * self.lame_constants[0])

    @property
    def relaxation_time(self) -> float:
        """Time in which an overstress falls to its e-th part [s]."""
        return 0.0

    def law_constants(self, dimension: int) -> tuple[float, float, float, float]:
        """Constants ``(mu [Pa], lambda [Pa], yield strain, relaxation time [s])``."""
        del dimension
        return *self.lame_constants, self.yield_strain, self.relaxation_time

    def return_map(
        self,
        b: Float[Tensor, "*n d d"],
        volume_correction: Float[Tensor, "*n"],
        *,
        substep_dt: float,
    ) -> tuple[Float[Tensor, "*n d d"], Float[Tensor, "*n"]]:
        """Let the deviator flow; see ``return_maps.viscoplastic_map``. Below yield: as given."""
        stretch, axes = principal_stretches(b)
        strain = stretch.log()
        kept = viscoplastic_map(
            strain,
            yield_strain=self.yield_strain,
            relaxation_time=self.relaxation_time,
            substep_dt=substep_dt,
        )
        yields = (kept != strain).any(-1)[..., None, None]
        return torch.where(yields, from_principal_strains(kept, axes), b), volume_correction


@dataclass(frozen=True, kw_only=True)
class VonMisesPlasticine(_Yielding):
    """Plasticine: elastic below its yield stress, keeps the shape it is pressed into.

    Perfect plasticity with the von Mises yield surface; flow keeps the volume.

    Source:
        Gao et al., "An Adaptive Generalized Interpolation Material Point Method for
        Simulating Elastoplastic Materials", ACM TOG 2017.
    """

    name: ClassVar[str] = "von_mises_plasticine"
    particle_type: ClassVar[int] = PLASTICINE


@dataclass(frozen=True, kw_only=True)
class ViscoplasticGoop(_Yielding):
    """Goop: holds a little stress for ever and flows slowly under more (a Bingham body).

    See ``return_maps.viscoplastic_map`` for the law and for its step in closed form.

    Source:
        Bingham, "Fluidity and Plasticity", 1922; Perzyna, "Fundamental Problems in
        Viscoplasticity", Advances in Applied Mechanics 9, 1966.
    """

    name: ClassVar[str] = "viscoplastic_goop"
    particle_type: ClassVar[int] = GOOP

    viscosity: float
    """Plastic viscosity ``eta``: slope of shear stress over shear rate in steady flow [Pa s];
    0 is plasticine."""

    def __post_init__(self) -> None:
        """Reject a negative viscosity."""
        super().__post_init__()
        require_not_negative(self, "viscosity", "Pa s")

    @property
    def relaxation_time(self) -> float:
        """Time in which an overstress falls to its e-th part, ``eta / mu`` [s]."""
        return self.viscosity / self.lame_constants[0]


@dataclass(frozen=True, kw_only=True)
class DruckerPragerSand(Hencky):
    """Dry sand: shear up to friction times pressure, no tension.

    See ``return_maps.sand_map``. Flow keeps the volume (no dilatancy).

    Source:
        Klár et al., "Drucker-Prager Elastoplasticity for Sand Animation", ACM TOG 2016;
        Tampubolon et al., "Multi-species simulation of porous sand and water mixtures",
        ACM TOG 2017, for the volume correction.
    """

    name: ClassVar[str] = "drucker_prager_sand"
    particle_type: ClassVar[int] = SAND

    friction_angle: float
    """Angle of internal friction, between 0 and 90 [degrees]. In 3-D that of triaxial compression;
    in plane flow the 3-D cone holds like a larger one (31 like 46, see ``cone_slope``)."""

    cohesion_strain: float = 0.0
    """Logarithmic strain per axis that holds before the grains part [-]; 0: dry."""

    volume_correction: bool = True
    """Remember how far grains came apart, so that bouncing sand does not gain volume."""

    def __post_init__(self) -> None:
        """Reject what is no angle of friction or no strain."""
        super().__post_init__()
        require_not_negative(self, "cohesion_strain", "(a strain)")
        if not 0.0 < self.friction_angle < 90.0:
            raise ValueError(
                f"{type(self).__name__}.friction_angle must lie between 0 and 90 degrees, got "
                f"{self.friction_angle!r}. Dry sand has 25 to 45."
            )

    def slope(self, dimension: int) -> float:
        """Slope ``k`` of the yield cone ``|dev e| + k tr e = 0`` in strains."""
        mu, lam = self.lame_constants
        alpha = cone_slope(self.friction_angle, dimension=dimension)
        return alpha * (dimension * lam + 2.0 * mu) / (2.0 * mu)

    def law_constants(self, dimension: int) -> tuple[float, float, float, float, float]:
        """Constants ``(mu [Pa], lambda [Pa], slope, cohesion strain, 1 if volume is kept)``."""
        kept = 1.0 if self.volume_correction else 0.0
        return *self.lame_constants, self.slope(dimension), self.cohesion_strain, kept

    def return_map(
        self,
        b: Float[Tensor, "*n d d"],
        volume_correction: Float[Tensor, "*n"],
        *,
        substep_dt: float,
    ) -> tuple[Float[Tensor, "*n d d"], Float[Tensor, "*n"]]:
        """Let the sand slide or part; see ``return_maps.sand_map``. Inside the cone: as given."""
        del substep_dt  # friction knows no rate
        stretch, axes = principal_stretches(b)
        strain = stretch.log()
        kept, volume = sand_map(
            strain,
            volume_correction,
            slope=self.slope(b.shape[-1]),
            cohesion_strain=self.cohesion_strain,
        )
        if not self.volume_correction:
            volume = torch.zeros_like(volume)
        yields = (kept != strain).any(-1)[..., None, None]
        return torch.where(yields, from_principal_strains(kept, axes), b), volume
