"""Everything the paper and its ablations switch on and off is a value of an experiment.

Each variant is given as the overrides a user would type; it is built, differs from the
recommended model in the way it claims, and takes a training step.
"""

from dataclasses import replace

import pytest
import torch

from giorom.config import load_experiment, merged
from giorom.experiment import build_simulator
from giorom.time_stepper import TimeStepper
from giorom.training.loop import StepperTraining
from giorom.training_data import load_training_data

NO_MESSAGES = {"layers_before": 0, "layers_after": 0}
FOURIER = {"processor": "fourier", "occupied_tokens": False, "fourier_modes": 4}
CONVOLUTION = {"processor": "convolution", "occupied_tokens": False, "convolution_width": 8}
FIRST_VERSION = FOURIER | {
    "processor": "fourier_plane",
    "latent_skip": False,
    "gno_input": "acceleration",
    "projection_layers": 2,
    "projection_width": 16,
}

NETWORKS = {
    "Table 4: NOT without interaction operators": NO_MESSAGES,
    "Table 4: GNO, FNO, GNO": NO_MESSAGES | FOURIER,
    "Table 4: IO, FNO, IO, native": FOURIER,
    "Table 4: 2 GNO, FNO, 2 GNO": NO_MESSAGES | FOURIER | {"gno_layers": 2},
    "IO, Transolver, IO": {"processor": "transolver", "slices": 4},
    "IO, CNN, IO": CONVOLUTION,
    "Table 5: IO, FNO, IO, on a plane": FIRST_VERSION,
    "Table 5: GNS": {"latent": False, "layers_before": 5, "layers_after": 5},
    "no processor": {"processor": "none"},
    "Table 10: message-passing layers": {"layers_before": 1, "layers_after": 1},
    "Table 12: latent grid": {"latent_side": 6},
    "figure 9: transformer layers": {"transformer_layers": 2},
    "figure 9: layers of the NOT networks": {"transformer_mlp_depth": 2},
    "figure 9: heads": {"heads": 8},
    "figure 9: experts": {"experts": 1},
    "figure 9: kernel width": {"gno_in_hidden": [16, 8], "gno_out_hidden": [16, 8]},
    "figure 9: kernel radius": {"latent_radius": 0.3},
    "figure 9: projection layers": {"projection_layers": 5, "projection_width": 16},
    "official kernel": {"gno_kernel": "official"},
    "official gate": {"gate_input": "features"},
    "official dropout": {"dropout": 0.3},
    "official node skip": {"node_skip": "linear"},
    "the paper's messages": {"distance_weight": False},
    "the paper's tokens": {"occupied_tokens": False},
    "margin of the grid": {"latent_padding": 0.1},
    "domain of the grid": {"latent_bounds": [[0.0, 1.0]] * 3},
}
"""Fields of the network each variant changes."""

RECIPES = {
    "Table 13: random samples": {"sampling": {"method": "random"}},
    "Table 13: every n-th particle": {"sampling": {"method": "stride"}},
    "Table 13: Delaunay": {"graph": {"kind": "delaunay", "configuration": "current"}},
    "Table 13: official Delaunay": {
        "graph": {"kind": "delaunay_official", "configuration": "current"}
    },
    "figure 6: sparsity": {"sampling": {"count": None, "reduction": 8.0}},
    "figure 8: noise": {"training": {"noise_std": 3e-4}},
    "figure 9: window": {"features": {"velocities": 6}},
    "no position loss": {"training": {"position_weight": 0.0}},
}
"""Other groups each variant changes."""


@pytest.fixture(scope="module")
def one_step(tiny_yaml, data_folder, tmp_path_factory):
    """Windows of the tiny experiment with overrides, and loss and weights after a step on two."""

    def run(overrides):
        experiment = load_experiment(str(tiny_yaml), overrides)
        data = load_training_data(experiment, data_folder)
        torch.manual_seed(0)
        simulator = build_simulator(experiment, data)
        training = StepperTraining(
            simulator.dynamics,
            experiment.training,
            windows=data.windows,
            connect=simulator.connect,
            seed=0,
            folder=tmp_path_factory.mktemp("variant"),
        )
        loss = training.train_step([0, 1], progress=0.0)
        weights = torch.cat([p.detach().flatten() for p in simulator.dynamics.parameters()])
        return data.windows, loss, weights

    return run


@pytest.fixture(scope="module")
def plain_loss(one_step):
    """Loss of the recommended model."""
    return one_step({})[1]


@pytest.mark.parametrize("name", NETWORKS)
def test_variant_of_the_network_is_a_matter_of_overrides(one_step, plain_loss, name):
    """Another network sees the same windows with the same seed: its loss is another."""
    _, loss, weights = one_step({"time_stepper": {"overrides": NETWORKS[name]}})
    assert 0.0 < loss < float("inf")
    assert bool(weights.isfinite().all())
    assert loss != plain_loss


@pytest.mark.parametrize("name", RECIPES)
def test_variant_of_the_recipe_is_a_matter_of_overrides(tiny_values, one_step, plain_loss, name):
    """Samples, graph, window, noise or loss are others, hence the loss of the same step is."""
    windows, loss, weights = one_step(RECIPES[name])
    assert 0.0 < loss < float("inf")
    assert bool(weights.isfinite().all())
    assert loss != plain_loss
    wanted = merged(tiny_values, RECIPES[name])["features"]["velocities"] + 1
    assert windows[0].state.history.shape[1] == wanted


@pytest.mark.parametrize("velocities", [2, 3, 5, 6, 7])
def test_the_window_is_as_many_velocities_as_asked_for(tiny, velocities):
    """Figure 9: as many vectors and two walls on each axis; 7 d features with the paper's five."""
    features = replace(tiny.features, velocities=velocities, rest_edges=False)
    assert features.node_width(3) == 3 * velocities + 6
    assert features.history == velocities + 1


def test_weights_fit_a_latent_grid_of_any_side(tiny):
    """Table 12 trains on one grid and runs on others: no weight belongs to a node."""
    bounds = [[0.0, 1.0]] * 3
    sides = {"transformer": 7, "fourier": 8, "transolver": 7, "convolution": 6}
    for name, side in sides.items():
        overrides = tiny.time_stepper.overrides | {"processor": name, "occupied_tokens": False}
        choice = replace(tiny.time_stepper, overrides=overrides | {"fourier_modes": 4})
        config = choice.build(dimension=3, features=tiny.features, latent_bounds=bounds)
        trained, finer = TimeStepper(config), TimeStepper(replace(config, latent_side=side))
        finer.load_state_dict(trained.state_dict())
        assert finer.latent.grid.node_count == side**3
