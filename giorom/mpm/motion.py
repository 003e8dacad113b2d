"""Initial velocity fields of a scene.

``clamped_velocity`` sets a standing body swinging: each part of it vanishes at the clamp
plane, so held and free particles agree there. ``thrown_velocity`` is a rigid motion.
Metres and seconds; axis 1 points up; NumPy only.
"""

import math
from typing import Any

import numpy as np
from jaxtyping import Float

IMPULSES = ("bend", "sway", "twist", "axial")
"""Parts of a clamped body's initial motion, from the strongest to the weakest."""

SECOND_NODE = 0.783
"""Where the second bending mode of a cantilever does not move [height]."""


def _direction(generator: np.random.Generator, dimension: int) -> np.ndarray:
    """A random horizontal unit vector."""
    direction = np.zeros(dimension)
    if dimension == 2:
        direction[0] = generator.choice([-1.0, 1.0])
        return direction
    angle = generator.uniform(0.0, 2.0 * math.pi)
    direction[0], direction[2] = math.cos(angle), math.sin(angle)
    return direction


def clamped_velocity(
    position: Float[np.ndarray, "p d"],
    *,
    clamp_plane: float,
    impulses: list[str],
    top_speed: float,
    generator: np.random.Generator,
) -> tuple[Float[np.ndarray, "p d"], dict[str, Any]]:
    r"""Bending, swaying, twisting and stretching motion of a body held at its foot.

    With the height ``s`` over the clamp, zero there and one at the top: bend ``s^n e_1`` with
    n from 1 to 2, sway ``s^2 (s_2 - s) e_2`` (like the second mode of a cantilever), twist
    about the vertical through the middle, and axial ``s e_y``; the sum is scaled so that the
    fastest particle has ``top_speed``.

    Args:
        position: Positions [m].
        clamp_plane: Height of the clamp [m].
        impulses: Which of ``IMPULSES`` take part.
        top_speed: Speed of the fastest particle [m/s].
        generator: Source of directions and amplitudes.

    Returns:
        Velocities [m/s] and what was drawn, as JSON values.
    """
    dimension = position.shape[1]
    above = np.maximum(position[:, 1] - clamp_plane, 0.0)
    s = (above / above.max())[:, None]
    power = float(generator.uniform(1.0, 2.0))
    bend, sway = _direction(generator, dimension), _direction(generator, dimension)
    around = position - position.mean(axis=0)
    turn = np.zeros_like(position)
    if dimension == 3:
        turn[:, 0], turn[:, 2] = around[:, 2], -around[:, 0]
        turn /= np.linalg.norm(turn, axis=1).max()
    up = np.zeros(dimension)
    up[1] = 1.0
    fields = {
        "bend": s**power * bend,
        "sway": s**2 * (SECOND_NODE - s) / (1.0 - SECOND_NODE) * sway,
        "twist": s * turn,
        "axial": s * up,
    }
    drawn = {"sway": 0.4, "twist": 0.4, "axial": 0.25}
    amplitude = {name: float(generator.uniform(-top, top)) for name, top in drawn.items()}
    amplitude["bend"] = 1.0
    velocity = sum(amplitude[name] * fields[name] for name in impulses)
    fastest = np.linalg.norm(velocity, axis=1).max()
    velocity = velocity * (top_speed / fastest if fastest > 0.0 else 0.0)
    return velocity, {
        "bend_power": power,
        "bend_direction": bend.tolist(),
        "sway_direction": sway.tolist(),
        "amplitudes": {name: amplitude[name] for name in impulses},
        "top_speed": top_speed,
    }


def thrown_velocity(
    position: Float[np.ndarray, "p d"],
    *,
    speed: float,
    spin: float,
    generator: np.random.Generator,
) -> tuple[Float[np.ndarray, "p d"], Float[np.ndarray, "d d"], dict[str, Any]]:
    """Rigid motion in a random direction, turning about a random axis.

    Args:
        position: Positions [m].
        speed: Speed of the centre of mass [m/s].
        spin: Angular speed [rad/s].
        generator: Source of direction and axis.

    Returns:
        Velocities [m/s], their gradient [1/s] (the affine velocity of every particle), and
        what was drawn, as JSON values.
    """
    dimension = position.shape[1]
    direction = generator.normal(size=dimension)
    linear = speed * direction / np.linalg.norm(direction)
    gradient = np.zeros((dimension, dimension))
    if dimension == 2:
        gradient[1, 0] = spin * generator.choice([-1.0, 1.0])
        gradient[0, 1] = -gradient[1, 0]
        angular = [float(gradient[1, 0])]
    else:
        axis = generator.normal(size=3)
        x, y, z = spin * axis / np.linalg.norm(axis)
        gradient[:] = [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]]
        angular = [float(x), float(y), float(z)]
    velocity = linear + (position - position.mean(axis=0)) @ gradient.T
    return velocity, gradient, {"linear_velocity": linear.tolist(), "angular_velocity": angular}
