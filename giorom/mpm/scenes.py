"""Random scenes: which body starts where, of what, and how fast.

A ``SceneConfig`` describes a family of scenes in plain values; ``draw_scene`` turns it and a
seed into one ``Scene``, always the same. SI units. This module needs no simulator.
"""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from giorom.mpm.bodies import Body, draw_bodies
from giorom.mpm.materials import Material, make_material
from giorom.mpm.scene import MaterialSwitch, Scene
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
    counts = torch.tensor([len(body.position) for body in bodies])
    held = torch.from_numpy(np.concatenate([body.kinematic for body in bodies]))
    choices = _choices(config)
    used = sorted({body.choice for body in bodies})
    types = torch.tensor([choices[body.choice][1] for body in bodies]).repeat_interleave(counts)
    gradients = torch.tensor(np.array([body.gradient for body in bodies])).float()
    return Scene(
        position=_joined([body.position for body in bodies]),
        velocity=_joined([body.velocity for body in bodies]),
        affine_velocity=gradients.repeat_interleave(counts, dim=0),
        volume=_joined([np.full(len(body.position), body.volume) for body in bodies]),
        particle_type=torch.where(held, KINEMATIC, types),
        materials=tuple(choices[choice][0] for choice in used),
        material_index=torch.tensor([used.index(body.choice) for body in bodies]).repeat_interleave(
            counts
        ),
        bounds=torch.tensor([[config.wall, 1.0 - config.wall]] * config.dimension),
        wall_contact=config.wall_contact,
        gravity=config.gravity,
        clamp_plane=bodies[0].clamp_plane,
        switch=_switch(config) if used[0] == 0 else None,
        attributes=_attributes(config, bodies, seed),
    )


def _choices(config: SceneConfig) -> list[tuple[Material, int]]:
    """Every material a body may be of, with its particle type."""
    first = make_material(config.material, config.material_parameters)
    choices = [(first, first.particle_type)]
    for choice in config.mixture:
        material = make_material(choice.material, choice.material_parameters)
        kind = choice.particle_type
        choices.append((material, material.particle_type if kind is None else kind))
    return choices


def _switch(config: SceneConfig) -> MaterialSwitch | None:
    """What the first material becomes, if it does."""
    change = config.switch
    if change is None:
        return None
    material = make_material(change.material, change.material_parameters)
    return MaterialSwitch(frame=change.frame, material_index=0, material=material)


def _joined(parts: list[np.ndarray]) -> Tensor:
    return torch.from_numpy(np.concatenate(parts)).float()


def _attributes(config: SceneConfig, bodies: list[Body], seed: int) -> dict[str, Any]:
    """What was drawn, as JSON values; several bodies are listed one by one."""
    shared = {
        "family": config.family,
        "seed": seed,
        "gravity": config.gravity,
        "wall_contact": config.wall_contact,
        "clamp_plane": bodies[0].clamp_plane,
    }
    if len(bodies) == 1:
        return shared | bodies[0].attributes
    names = [config.material, *(choice.material for choice in config.mixture)]
    return shared | {
        "shape": "+".join(body.shape.name for body in bodies),
        "bodies": [
            body.attributes | {"material": names[body.choice], "points": len(body.position)}
            for body in bodies
        ],
    }
