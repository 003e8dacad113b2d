"""Material point simulator: scenes in, full-order trajectories out.

Stage 1 of the pipeline. Importing it starts no simulator: Warp and trimesh are loaded only
by ``simulate`` and by the reading of a mesh file.
"""

from giorom.mpm.materials import (
    DruckerPragerSand,
    FixedCorotated,
    StableNeoHookean,
    ViscoplasticGoop,
    VonMisesPlasticine,
    WeaklyCompressibleFluid,
    make_material,
)
from giorom.mpm.scene import MaterialSwitch, Scene
from giorom.mpm.scene_config import SceneConfig
from giorom.mpm.scenes import draw_scene
from giorom.mpm.simulate import SimulationError, SolverConfig, require_runnable, simulate

__all__ = [
    "DruckerPragerSand",
    "FixedCorotated",
    "MaterialSwitch",
    "Scene",
    "SceneConfig",
    "SimulationError",
    "SolverConfig",
    "StableNeoHookean",
    "ViscoplasticGoop",
    "VonMisesPlasticine",
    "WeaklyCompressibleFluid",
    "draw_scene",
    "make_material",
    "require_runnable",
    "simulate",
]
