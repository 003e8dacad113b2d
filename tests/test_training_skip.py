"""The pointwise start of a time-stepper against a law it can express."""

import pytest
import torch

from giorom.data.windows import Windows, sample_trajectories
from giorom.features import DISPLACEMENT_GAIN, FeatureConfig
from giorom.normalization import Normalization
from giorom.pipeline import Dynamics
from giorom.sampling import SamplingConfig
from giorom.state import Trajectory
from giorom.time_stepper import TimeStepper, TimeStepperConfig
from giorom.training.skip import fit_skip
from giorom.training.training_config import TrainingConfig


def test_the_linear_part_finds_a_spring():
    """Accelerations -k (x - X) are linear in the displacement: all variance is explained."""
    stiffness, frame_dt, radius = 30.0, 0.01, 0.3
    generator = torch.Generator().manual_seed(0)
    reference = torch.rand(20, 2, generator=generator)
    positions = [reference, reference + 0.01 * torch.randn(20, 2, generator=generator)]
    while len(positions) < 40:
        force = -stiffness * (positions[-1] - reference)
        positions.append(2.0 * positions[-1] - positions[-2] + frame_dt**2 * force)
    body = Trajectory(
        position=torch.stack(positions),
        particle_type=torch.full((20,), 8),
        frame_dt=frame_dt,
        bounds=torch.tensor([[-1.0, 2.0]] * 2),
    )
    features = FeatureConfig(velocities=1, displacement=True)
    network = TimeStepper(
        TimeStepperConfig.default(
            2,
            latent_bounds=[[-1.0, 2.0]] * 2,
            node_width=features.node_width(2),
            hidden=8,
            latent_side=4,
            latent_width=8,
            transformer_width=8,
            heads=2,
            input_skip="linear",
        )
    )
    scale = Normalization(
        velocity_mean=(0.0, 0.0),
        velocity_std=(1.0, 1.0),
        acceleration_mean=(0.0, 0.0),
        acceleration_std=(2.0, 2.0),
    )
    model = Dynamics(network, features=features, normalization=scale, radius=radius)
    data = sample_trajectories([body], SamplingConfig(count=20), subsets=1, reference_radius=radius)
    share = fit_skip(
        model,
        Windows(data, history=2, future=1),
        TrainingConfig(),
        seed=0,
        minutes=1.0,
        report=lambda numbers: None,
    )
    assert share > 1.0 - 1e-5
    # Displacement channels are (x - X) / radius * gain and the output is a / 2.
    expected = -stiffness * radius / DISPLACEMENT_GAIN / 2.0
    found = network.input_skip.linear.weight[:, -2:].diagonal()
    assert found.tolist() == pytest.approx([expected] * 2, rel=1e-2)
