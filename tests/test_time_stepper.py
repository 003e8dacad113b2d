"""The time-stepper's presets, its checks and its latent grid. The contract is in contracts/."""

import math
from dataclasses import replace

import pytest
import torch

from giorom.features import Features
from giorom.graph import radius_edges
from giorom.time_stepper import TimeStepper, TimeStepperConfig

UNIT = [[0.0, 1.0]] * 3
SMALL = {"hidden": 16, "latent_side": 4, "transformer_width": 16, "latent_width": 8}


def features(count: int = 40, radius: float = 0.35) -> Features:
    """Two random scenes of ``count`` particles in the unit cube, in float64."""
    generator = torch.Generator().manual_seed(0)
    position = torch.rand(2 * count, 3, generator=generator, dtype=torch.float64)
    batch = torch.arange(2).repeat_interleave(count)
    edges = radius_edges(position, batch, radius)
    vector = (position[edges.sender] - position[edges.receiver]) / radius
    return Features(
        node=torch.randn(2 * count, 21, generator=generator, dtype=torch.float64),
        particle_type=torch.full((2 * count,), 5),
        edge=torch.cat([vector, vector.norm(dim=1, keepdim=True)], dim=1),
        edges=edges,
        position=position,
        batch=batch,
        batch_size=2,
    )


def make(**options: object) -> TimeStepper:
    """A small recommended model in float64, always with the same weights."""
    torch.manual_seed(0)
    values = {"latent_bounds": UNIT} | SMALL | options
    return TimeStepper(TimeStepperConfig.default(**values)).double()


@pytest.mark.parametrize(
    ("node_skip", "expected"),
    [(True, 2_387_669), ("linear", 2_387_669), (False, 2_321_621), ("none", 2_321_621)],
)
def test_the_paper_preset_has_the_published_number_of_parameters(node_skip, expected):
    """2.39 M on the model cards; the sum over all layers is in the method notes, 3.2."""
    model = TimeStepper(TimeStepperConfig.paper(node_skip=node_skip))
    assert sum(parameter.numel() for parameter in model.parameters()) == expected


FIRST_VERSION = {
    "node_skip": "none",
    "processor": "fourier_plane",
    "latent_skip": False,
    "gno_input": "acceleration",
    "latent_radius": 0.145,
    "latent_width": 3,
    "fourier_modes": 24,
    "projection_layers": 2,
    "projection_width": 16,
}
"""What the first version of arXiv:2407.03925 changes in three dimensions: IO, FNO, IO."""


def parameter_count(model: torch.nn.Module) -> int:
    """All numbers of a network."""
    return sum(parameter.numel() for parameter in model.parameters())


def test_the_first_version_has_the_published_number_of_parameters():
    """2,006,574 with 1,288,736 in the Fourier operator, complex weights as two numbers each."""
    model = TimeStepper(TimeStepperConfig.paper(**FIRST_VERSION))
    assert parameter_count(model) == 2_006_574
    assert parameter_count(model.latent.fourier) == 1_288_736


@pytest.mark.parametrize(
    ("changes", "published", "unused"),
    [
        # Table 8's GNS: ten layers, no grid; a map from 3 to 2 axes that nothing calls.
        (
            {"latent": False, "node_skip": "none", "layers_before": 5, "layers_after": 5},
            1_592_987,
            8,
        ),
        # The configuration file of the official code at its head: its kernel gives 64 channels to
        # a transformer that takes 128, so that it cannot run; with 128 the kernel is larger.
        (
            {"latent_width": 128, "transformer_layers": 2, "projection_layers": 3},
            3_690_199,
            -(64 + 1) * 64,
        ),
        ({"dimension": 2}, 3_493_694, 8),
    ],
)
def test_other_published_numbers_of_parameters_follow_too(changes, published, unused):
    """What is published counts layers that nothing calls, or lacks some that are needed."""
    model = TimeStepper(TimeStepperConfig.paper(**changes))
    assert parameter_count(model) == published - unused


def test_the_default_preset_reaches_every_particle_and_has_a_close_size():
    """The default radius is 1.5 times what covers the grid."""
    model = TimeStepper(TimeStepperConfig.default(latent_bounds=UNIT))
    grid = model.latent.grid
    assert grid.reach == pytest.approx(1.5 * grid.covering_radius)
    assert 2.2e6 < sum(parameter.numel() for parameter in model.parameters()) < 2.5e6


def test_the_published_grids_reach_all_points_in_space_and_43_percent_in_the_plane():
    """Area of the discs of radius 0.024 about nodes 2/31 apart: pi (0.024 / (2/31))^2 = 0.434."""
    for dimension, expected in ((3, 1.0), (2, math.pi * (0.024 * 31.0 / 2.0) ** 2)):
        model = TimeStepper(TimeStepperConfig.paper(dimension))
        generator = torch.Generator().manual_seed(0)
        position = torch.rand(20_000, dimension, generator=generator)
        # Spread of a share of 20,000 points: 0.0035.
        assert float(model.coverage(position)) == pytest.approx(expected, abs=0.015)


def test_moving_body_and_grid_together_changes_nothing():
    """The model knows places only relative to its grid."""
    before, shift = features(), 0.125
    after = replace(before, position=before.position + shift)
    moved = make(latent_bounds=[[low + shift, high + shift] for low, high in UNIT])
    torch.testing.assert_close(moved(after), make()(before), rtol=0, atol=1e-10)


def test_scaling_body_and_grid_together_changes_nothing():
    """Metres or millimetres: the features are dimensionless and the grid is relative."""
    before, scale = features(), 1024.0
    after = replace(before, position=before.position * scale)
    scaled = make(latent_bounds=[[low * scale, high * scale] for low, high in UNIT])
    torch.testing.assert_close(scaled(after), make()(before), rtol=0, atol=1e-10)


def test_moving_the_body_in_the_grid_does_change_the_result():
    """Why the model is not translation invariant: the grid is fixed in the domain."""
    before = features()
    after = replace(before, position=before.position + 0.125)
    assert (make()(after) - make()(before)).abs().max() > 1e-3


def test_leaving_out_empty_tokens_changes_nothing_when_none_is_empty():
    """With a reach that makes every node occupied both ways see the same tokens."""
    options = {"latent_side": 3, "latent_radius": 0.6}
    full, occupied = (make(occupied_tokens=flag, **options) for flag in (False, True))
    scene = features(count=200)
    torch.testing.assert_close(occupied(scene), full(scene), rtol=0, atol=1e-10)


def test_leaving_out_empty_tokens_matters_when_some_are_empty():
    """The attention is then a mean over the body, not over the box."""
    corner = replace(features(), position=features().position * 0.3)
    full, occupied = (make(occupied_tokens=flag) for flag in (False, True))
    assert (full(corner) - occupied(corner)).abs().max() > 1e-6


def test_the_grid_adds_nothing_to_particles_out_of_its_reach():
    """An empty ball gives zero before the projection, hence its bias alone."""
    model, scene = make(), features()
    far = replace(scene, position=scene.position + 100.0)
    node = torch.randn(80, 16, dtype=torch.float64)
    added = model.latent(node, far)
    torch.testing.assert_close(added, model.latent.projection.layers[0].bias.expand_as(added))
    assert float(model.coverage(far.position)) == 0.0
    assert float(model.coverage(scene.position)) == 1.0


FOURIER = {"occupied_tokens": False, "fourier_modes": 3, "fourier_width": 4, "fourier_hidden": 4}


def test_without_a_processor_the_grid_is_two_means_around_a_linear_map():
    """Written out with a table of all distances: encoder, linear map, decoder, projection."""
    model, scene = make(processor="none"), features()
    latent, first = model.latent, scene.position[scene.batch == 0]
    node = torch.randn(80, 16, dtype=torch.float64)
    grid = latent.grid
    place = grid.node_unit(torch.arange(64), first)  # the bounds are the unit cube
    offset = (first[:, None] - place) / grid.reach
    near = (offset.square().sum(dim=2) <= 1.0).double()
    ask = torch.cat([offset, place.expand(40, -1, -1), node[:40, None].expand(-1, 64, -1)], dim=2)
    token = torch.einsum("qt,qtc->tc", near, latent.encode.kernel(ask))
    token = latent.pointwise(token / near.sum(dim=0)[:, None].clamp_min(1.0))
    ask = torch.cat([-offset, first[:, None].expand(-1, 64, -1)], dim=2)
    back = torch.einsum("qt,qtc,tc->qc", near, latent.decode.kernel(ask), token)
    expected = latent.projection(back / near.sum(dim=1)[:, None])
    torch.testing.assert_close(latent(node, scene)[:40], expected, rtol=0, atol=1e-12)


def test_second_kernel_integrals_are_means_over_the_neighbours_on_the_graph():
    """Loops over the particles: v + mean kappa(y - x, x, v(y)), grid, w + mean kappa' w(y)."""
    one, two, scene = make(processor="none"), make(processor="none", gno_layers=2), features()
    latent, count = two.latent, len(scene.position)
    assert not latent.load_state_dict(one.latent.state_dict(), strict=False).unexpected_keys
    node = torch.randn(count, 16, dtype=torch.float64)
    place, sender, receiver = scene.position, scene.edges.sender, scene.edges.receiver

    def looped(value, kernel, *, sees_value):
        rows = []
        for particle in range(count):
            near = sender[receiver == particle]
            offset = scene.edge[receiver == particle, :3]
            seen = [offset, place[particle].expand(len(near), -1)]
            if sees_value:
                rows.append(kernel(torch.cat([*seen, value[near]], dim=1)).mean(dim=0))
            else:
                rows.append((kernel(torch.cat(seen, dim=1)) * value[near]).mean(dim=0))
        return value + torch.stack(rows)

    sent = looped(node, latent.encode_near.kernel, sees_value=True)
    one.latent.projection = torch.nn.Identity()
    received = looped(one.latent(sent, scene), latent.decode_near.kernel, sees_value=False)
    expected = latent.projection(received)
    torch.testing.assert_close(latent(node, scene), expected, rtol=0, atol=1e-12)


def test_a_padded_grid_goes_beyond_its_bounds_by_a_share_of_their_width():
    """An eighth on each side; the same as bounds a quarter wider."""
    padded = make(latent_padding=0.125, latent_bounds=[[0.0, 1.0], [-1.0, 1.0], [2.0, 6.0]])
    wider = [[-0.125, 1.125], [-1.25, 1.25], [1.5, 6.5]]
    assert padded.latent.grid.bounds == wider
    assert padded.latent.grid.reach == make(latent_bounds=wider).latent.grid.reach


def test_without_skip_the_grid_replaces_the_node_features():
    """With a projection that gives zero nothing of the particle is left: all answers are equal."""
    for skip, spread in ((True, True), (False, False)):
        model = make(latent_skip=skip, layers_after=0)
        with torch.no_grad():
            for parameter in model.latent.projection.parameters():
                parameter.zero_()
            output = model(features())
        assert bool((output - output[0]).abs().max() > 1e-6) == spread


def test_the_grid_reads_decoded_accelerations_if_asked_to():
    """Features that decode to the same acceleration look the same to the grid."""
    model, scene = make(gno_input="acceleration", layers_before=0), features()
    assert model.latent.encode.kernel.layers[0].in_features == 6 + 3
    with torch.no_grad():
        model.node_out.layers[-1].weight.zero_()
    sent = []
    model.latent.register_forward_hook(lambda _, given, __: sent.append(given[0]))
    model(scene)
    torch.testing.assert_close(sent[0], model.node_out.layers[-1].bias.expand(80, 3))


def test_particles_that_fall_on_each_other_in_the_plane_read_the_same_from_it():
    """The learned map forgets a direction: moving along it changes nothing (first version)."""
    model = make(processor="fourier_plane", gno_kernel="official", **FOURIER)
    scene, node = features(), torch.randn(80, 16, dtype=torch.float64)
    forgotten = torch.linalg.svd(model.latent.to_plane.weight.detach())[2][2]
    moved = replace(scene, position=scene.position + 0.1 * forgotten)
    other = replace(scene, position=scene.position + 0.1 * forgotten.roll(1))
    before = model.latent(node, scene)
    torch.testing.assert_close(model.latent(node, moved), before, rtol=0, atol=1e-10)
    assert (model.latent(node, other) - before).abs().max() > 1e-6
    assert float(model.coverage(scene.position)) == 1.0


def test_a_fourier_operator_on_the_grid_reaches_across_the_body():
    """One layer couples every node with every other; message passing alone does not."""
    scene = features(radius=0.05)
    far = scene.position[:40].norm(dim=1).argmax()
    for options, reached in (
        ({"processor": "fourier"} | FOURIER, True),
        ({"processor": "none"}, False),
    ):
        model = make(**options)
        disturbed = replace(scene, node=scene.node.clone())
        disturbed.node[far] += 1.0
        change = (model(disturbed) - model(scene)).detach().abs().amax(dim=1)
        nearest = scene.position[:40].norm(dim=1).argmin()
        assert bool(change[nearest] > 1e-9) == reached
        assert float(change[40:].max()) == 0.0


def test_without_message_passing_no_edge_is_read():
    """GNO, FNO, GNO of the ablations (Table 4): no edge network is left to train."""
    model = make(layers_before=0, layers_after=0, processor="fourier", **FOURIER)
    assert model.edge_in is None
    scene = features()
    other = replace(scene, edge=torch.zeros_like(scene.edge))
    torch.testing.assert_close(model(other), model(scene), rtol=0, atol=0)


def test_without_grid_coverage_is_complete():
    """Nothing is missed where nothing is asked."""
    assert float(make(latent=False).coverage(features().position)) == 1.0


def test_extra_edge_channels_are_read():
    """Rest-shape channels follow the relative position and change the result."""
    scene = features()
    extra = torch.randn(len(scene.edge), 8, dtype=torch.float64)
    model = make(edge_width=12)
    one, other = (
        model(replace(scene, edge=torch.cat([scene.edge, part], dim=1))) for part in (extra, -extra)
    )
    assert (one - other).abs().max() > 1e-3


def test_deeper_variants_run():
    """Layers, projection and experts beyond the presets."""
    model = make(
        transformer_layers=2,
        transformer_mlp_depth=0,
        projection_layers=3,
        projection_width=8,
        experts=3,
        expert_hidden=5,
        node_skip="linear",
        distance_weight=False,
        layers_before=0,
        layers_after=3,
    )
    assert model(features()).isfinite().all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"dimension": 4}, r"dimension must be one of \(2, 3\), got 4"),
        ({"dropout": 1.0}, r"dropout is a share and must be in \[0, 1\), got 1.0"),
        ({"hidden": 0}, "hidden must be >= 1, got 0"),
        ({"layers_before": -1}, "layers_before must be >= 0, got -1"),
        ({"edge_width": 3}, "edge_width=3 has no room"),
        ({"heads": 3}, "heads=3 must divide transformer_width=256"),
        ({"latent_side": 1}, "latent_side must be >= 2 nodes, got 1"),
        ({"latent_bounds": [[0.0, 1.0]]}, "latent_bounds must be 3 pairs"),
        ({"latent_bounds": [[0.0, 1.0], [1.0, 0.0], [0.0, 1.0]]}, "with low < high"),
        ({"latent_radius": 0.0}, "latent_radius must be > 0 m, got 0.0"),
        ({"fourier_modes": 0}, "fourier_modes must be >= 1, got 0"),
        (
            {"processor": "fourier", "occupied_tokens": True},
            "needs every node of the grid.*Set occupied_tokens to False",
        ),
        ({"dimension": 2, "processor": "fourier_plane"}, "maps 3-D bodies.*Use processor"),
        ({"processor": "convolution", "occupied_tokens": True}, "needs every node of the grid"),
        ({"latent_padding": -0.1}, r"latent_padding is a share .* must be in \[0, 1\], got -0.1"),
        ({"gno_layers": 2, "gno_input": "acceleration"}, "gno_layers=2 integrates node features"),
        ({"gno_layers": 2, "processor": "fourier_plane"}, "gno_layers=2 integrates node features"),
        ({"slices": 0}, "slices must be >= 1, got 0"),
        ({"convolution_layers": 0}, "convolution_layers must be >= 1, got 0"),
    ],
)
def test_impossible_values_are_refused(changes, message):
    """Each message names the field, the rule and the value."""
    with pytest.raises(ValueError, match=message):
        TimeStepperConfig.paper(**changes)


@pytest.mark.parametrize(
    "name", ["node_skip", "gno_kernel", "gno_input", "gno_layers", "gate_input", "processor"]
)
def test_unknown_choices_are_refused(name):
    """By the class itself (ValueError), or before it by the run-time check of the annotations."""
    values = {"dimension": 3, "node_width": 21, "edge_width": 4, "latent_bounds": UNIT}
    with pytest.raises((ValueError, TypeError), match=name):
        TimeStepperConfig(**values, **{name: "other"})


@pytest.mark.parametrize(("skip", "gate_width"), [("linear", 0), ("gated", 9)])
def test_a_new_model_with_a_skip_is_its_linear_map(skip, gate_width):
    """Network and gate start at zero, so only the linear map of the features is left."""
    model, given = make(node_width=21, input_skip=skip, gate_width=gate_width), features()
    with torch.no_grad():
        model.input_skip.linear.weight.normal_()
    torch.testing.assert_close(model(given), given.node @ model.input_skip.linear.weight.T)


def test_a_gate_multiplies_the_moving_channels_with_what_the_shape_chooses():
    """With only the bias G of the gate set, the output is G n for the first channels n."""
    model, given = make(node_width=21, input_skip="gated", gate_width=9), features()
    gate = torch.randn(3, 12, dtype=torch.float64, generator=torch.Generator().manual_seed(1))
    with torch.no_grad():
        model.input_skip.gate.layers[-1].bias.copy_(gate.flatten())
    torch.testing.assert_close(model(given), given.node[:, :12] @ gate.T)


def test_a_gate_needs_a_description_of_the_rest_shape():
    """A gated skip without channels for the gate is refused with the way out."""
    with pytest.raises(ValueError, match="rest_shape"):
        make(node_width=21, input_skip="gated")
