"""The whole method: from a sparse state to the full-order motion (Algorithm 1).

Stages 3 to 6 composed. ``rollout`` is the loop; what moves the samples and what recovers the
other points are handed in, so that an oracle can stand in for either.
"""

from collections.abc import Callable, Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from giorom.features import FeatureConfig, Features, compute_features
from giorom.graph import Edges, connect_points
from giorom.integrate import advance
from giorom.normalization import Normalization
from giorom.sampling import represented_particles
from giorom.state import Body, SparseState, Trajectory

Acceleration = Callable[[SparseState, Edges], Tensor]
"""Stage 4: accelerations [m/s^2] of the samples, shape (q, d), from their state and graph."""

Step = Callable[[SparseState, Edges, Tensor | None], SparseState]
"""Stages 4 and 5: the state one frame later, from the state, its graph and the positions of which
the kinematic rows are prescribed [m]; without those, kinematic particles stay where they are."""

Connect = Callable[[SparseState], Edges]
"""Stage 3: the interaction graph of a sparse state."""

Decode = Callable[[Tensor], Tensor]
"""Stage 6: positions of all points, shape (p, d), from those of the samples, shape (q, d) [m]."""


class Dynamics(nn.Module):
    """Features, network and scales together: the acceleration of a sparse state in SI units.

    Args:
        time_stepper: Network from features to normalised acceleration.
        features: Which features it expects.
        normalization: Scales it was trained with.
        radius: Graph radius it was trained with [m].
    """

    def __init__(
        self,
        time_stepper: Callable[[Features], Tensor],
        *,
        features: FeatureConfig,
        normalization: Normalization,
        radius: float,
    ) -> None:
        super().__init__()
        self.time_stepper = time_stepper
        self.features, self.normalization, self.radius = features, normalization, radius

    def normalized(self, state: SparseState, edges: Edges) -> Float[Tensor, "q d"]:
        """Dimensionless acceleration, which the training loss compares."""
        features = compute_features(
            state, edges, self.features, normalization=self.normalization, radius=self.radius
        )
        return self.time_stepper(features)

    def forward(self, state: SparseState, edges: Edges) -> Float[Tensor, "q d"]:
        """Acceleration of every sample [m/s^2]."""
        return self.normalization.physical_acceleration(self.normalized(state, edges))

    def start(self, state: SparseState, velocity: Float[Tensor, "q d"]) -> SparseState:
        """The state of undeformed samples with a known velocity [m/s]: its history says it all."""
        del velocity
        return state

    def step(
        self,
        state: SparseState,
        edges: Edges,
        prescribed: Float[Tensor, "q d"] | None = None,
    ) -> SparseState:
        """The state one frame later; kinematic samples go where ``prescribed`` says [m]."""
        return advance(state, self(state, edges), prescribed=prescribed)


def integrated(acceleration: Acceleration) -> Step:
    """Stages 4 and 5 from stage 4 alone: semi-implicit Euler moves what it accelerates."""

    def step(state: SparseState, edges: Edges, prescribed: Tensor | None = None) -> SparseState:
        return advance(state, acceleration(state, edges), prescribed=prescribed)

    return step


def connect_within(radius: float, *, configuration: str, kind: str = "radius") -> Connect:
    """Stage 3 as a function: the graph of the current or of the reference positions."""

    def connect(state: SparseState) -> Edges:
        position = state.reference if configuration == "reference" else state.position
        return connect_points(position, state.batch, radius=radius, kind=kind)

    def connect_once(state: SparseState) -> Edges:
        if not known or known[0] is not state.reference:
            known[:] = [state.reference, connect(state)]
        return known[1]

    known: list = []
    return connect_once if configuration == "reference" else connect


def unconnected(state: SparseState) -> Edges:
    """The graph without edges, for steps that need none."""
    none = torch.zeros(0, dtype=torch.long, device=state.batch.device)
    return Edges(sender=none, receiver=none, offset=none.new_zeros(len(state.batch) + 1))


def rollout(
    state: SparseState,
    frames: int,
    *,
    connect: Connect,
    step: Step,
    prescribed: Float[Tensor, "t q d"] | None = None,
) -> Iterator[SparseState]:
    """Simulate the samples: graph and step, frame after frame.

    No gradients are recorded.

    Args:
        state: Initial sparse state.
        frames: Number of frames to add.
        connect: Stage 3.
        step: Stages 4 and 5.
        prescribed: Positions at each of the frames to come, of which the kinematic rows are used
            [m]; by default kinematic particles stay where they are.

    Yields:
        The state after each frame.

    Raises:
        ValueError: If the prescribed motion ends before the rollout.
        FloatingPointError: If a position stops being finite; says at which frame.

    Source:
        arXiv:2407.03925v2, Algorithm 1.
    """
    if prescribed is not None and len(prescribed) < frames:
        raise ValueError(
            f"the motion of the kinematic particles is known for {len(prescribed)} frames, but "
            f"{frames} are to be simulated. Ask for at most {len(prescribed)}."
        )
    for frame in range(frames):
        known = None if prescribed is None else prescribed[frame]
        with torch.no_grad():
            edges = connect(state)
            state = step(state, edges, known)
        if not bool(torch.isfinite(state.position).all()):
            raise FloatingPointError(
                f"the rollout is no longer finite at frame {frame + 1} of {frames}: the "
                f"time-stepper has diverged. Use fewer frames, or a scene closer to its training."
            )
        yield state


def full_order_rollout(
    state: SparseState,
    frames: int,
    *,
    connect: Connect,
    step: Step,
    decode: Decode,
    prescribed: Float[Tensor, "t q d"] | None = None,
) -> Iterator[Float[Tensor, "p d"]]:
    """Algorithm 1 to its end: positions of all points, frame after frame [m]."""
    for sparse in rollout(state, frames, connect=connect, step=step, prescribed=prescribed):
        yield decode(sparse.position)


def start_from_velocity(
    reference: Float[Tensor, "q d"],
    velocity: Float[Tensor, "q d"],
    *,
    particle_type: Int[Tensor, " q"],
    bounds: Float[Tensor, "d 2"],
    frame_dt: float,
    history: int,
    weight: Float[Tensor, " q"] | None = None,
    body: Body | None = None,
) -> SparseState:
    """A sparse state at rest shape and given velocity; earlier frames are its straight past.

    Args:
        reference: Initial positions of the samples [m].
        velocity: Initial velocities [m/s].
        particle_type: GNS particle types.
        bounds: Walls of the domain [m].
        frame_dt: Time between frames [s].
        history: Frames the time-stepper looks back on.
        weight: Full-order particles each sample stands for.
        body: The body they are samples of.
    """
    steps = torch.arange(history - 1, -1, -1, dtype=reference.dtype, device=reference.device)
    past = reference[:, None] - velocity[:, None] * (steps * frame_dt)[None, :, None]
    return SparseState(
        history=past,
        reference=reference,
        particle_type=particle_type,
        batch=torch.zeros(len(reference), dtype=torch.long, device=reference.device),
        batch_size=1,
        bounds=bounds,
        frame_dt=frame_dt,
        weight=weight,
        bodies=None if body is None else (body,),
    )


def start_from_trajectory(
    trajectory: Trajectory, samples: Int[Tensor, " q"], *, history: int, frame: int | None = None
) -> SparseState:
    """A sparse state whose last ``history`` frames are those of a trajectory up to ``frame``.

    Raises:
        ValueError: If the trajectory is too short.
    """
    frame = history - 1 if frame is None else frame
    if not history - 1 <= frame < trajectory.frame_count:
        raise ValueError(
            f"frame {frame} cannot be the last of {history} given frames of a trajectory of "
            f"{trajectory.frame_count}; it must lie in [{history - 1}, {trajectory.frame_count})."
        )
    chosen = trajectory.subset(samples)
    window = chosen.position[frame - history + 1 : frame + 1]
    return SparseState(
        history=window.transpose(0, 1).contiguous(),
        reference=chosen.position[0],
        particle_type=chosen.particle_type,
        batch=torch.zeros(len(samples), dtype=torch.long, device=window.device),
        batch_size=1,
        bounds=trajectory.bounds,
        frame_dt=trajectory.frame_dt,
        weight=represented_particles(trajectory.position[0], samples),
        bodies=(trajectory.body,),
    )
