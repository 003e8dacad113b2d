"""Random scenes: which body starts where, of what, and how fast.

A ``SceneConfig`` describes a family of scenes in plain values; ``draw_scene`` turns it and a
seed into one ``Scene``, always the same. SI units. This module needs no simulator.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from giorom.mpm.bodies import Body, draw_bodies
from giorom.mpm.materials import make_material
from giorom.mpm.scene import Scene
from giorom.mpm.scene_config import SceneConfig
from giorom.state import KINEMATIC


def draw_scene(config: SceneConfig, *, seed: int, shape: str | None = None) -> Scene:
    """Draw one scene of a family.

    Args:
        config: The family.
        seed: Number of the scene; the same seed gives the same scene.
        shape: Name of a shape, held-out ones too, or path of a closed mesh file, for every
            body in place of a drawn name.

    Returns:
        The scene.

    Raises:
        ValueError: If the shape is unknown or unusable, a body reaches beyond the walls, or
            finds no place apart from the others.
    """
    bodies = draw_bodies(config, seed=seed, shape=shape)
    material = make_material(config.material, config.material_parameters)
    held = np.concatenate([body.kinematic for body in bodies])
    counts = [len(body.position) for body in bodies]
    gradients = torch.tensor(np.array([body.gradient for body in bodies])).float()
    return Scene(
        position=_joined([body.position for body in bodies]),
        velocity=_joined([body.velocity for body in bodies]),
        affine_velocity=gradients.repeat_interleave(torch.tensor(counts), dim=0),
        volume=_joined([np.full(len(body.position), body.volume) for body in bodies]),
        particle_type=torch.from_numpy(np.where(held, KINEMATIC, material.particle_type)),
        materials=(material,),
        material_index=torch.zeros(len(held), dtype=torch.long),
        bounds=torch.tensor([[config.wall, 1.0 - config.wall]] * config.dimension),
        wall_contact=config.wall_contact,
        gravity=config.gravity,
        clamp_plane=bodies[0].clamp_plane,
        attributes=_attributes(config, bodies, seed),
    )


def _joined(parts: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.concatenate(parts)).float()


def _attributes(config: SceneConfig, bodies: list[Body], seed: int) -> dict[str, Any]:
    """What was drawn, as JSON values; several bodies are listed one by one."""
    shared = {
        "family": config.family,
        "seed": seed,
        "spacing": config.spacing,
        "gravity": config.gravity,
        "wall_contact": config.wall_contact,
        "clamp_plane": bodies[0].clamp_plane,
    }
    if len(bodies) == 1:
        return shared | bodies[0].attributes
    return shared | {
        "shape": "+".join(body.shape.name for body in bodies),
        "bodies": [body.attributes for body in bodies],
    }
