"""A stored simulator: the same rollouts back, or one clear line."""

import json
import math
import shutil
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from giorom.mpm import draw_scene
from giorom.simulator import Simulator, SimulatorConfig


@pytest.fixture
def scene(tiny):
    """A body the tiny simulator was not trained on."""
    return draw_scene(tiny.scene, seed=99, shape="capsule")


@pytest.fixture
def stored(run_folder, tmp_path):
    """A copy of the stored simulator, free to be damaged."""
    return shutil.copytree(run_folder / "simulator", tmp_path / "simulator")


def refused(folder):
    """The one line with which a folder is refused."""
    with pytest.raises(ValueError, match=r".") as caught:
        Simulator.from_pretrained(folder)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def edit(folder, change):
    """Change the stored configuration."""
    record = json.loads((folder / "config.json").read_text())
    change(record)
    (folder / "config.json").write_text(json.dumps(record))


def test_stored_and_loaded_simulator_rolls_out_the_same(simulator, scene, tmp_path):
    """Bit for bit; configuration and weights both survive."""
    simulator.save_pretrained(tmp_path)
    other = Simulator.from_pretrained(tmp_path)
    assert other.config == simulator.config
    arguments = (scene.position, scene.velocity, scene.particle_type)
    first, second = (s.rollout(*arguments, frames=3) for s in (simulator, other))
    assert torch.equal(first.position, second.position)


def test_model_of_the_first_stored_form_is_the_same_model(simulator, stored, scene):
    """Version 1 had the values of the neural basis, the one field it knew, in ``field`` itself."""

    def downgrade(record):
        record["format_version"] = 1
        record["field"] = record["field"]["neural_basis"]

    edit(stored, downgrade)
    other = Simulator.from_pretrained(stored)
    assert other.config == simulator.config
    arguments = (scene.position, scene.velocity, scene.particle_type)
    first, second = (s.rollout(*arguments, frames=2) for s in (simulator, other))
    assert torch.equal(first.position, second.position)


def test_run_folder_and_simulator_folder_name_the_same_model(run_folder):
    """``giorom rollout R`` takes the folder of the run."""
    inner = Simulator.from_pretrained(run_folder / "simulator")
    outer = Simulator.from_pretrained(run_folder)
    for ours, theirs in zip(inner.parameters(), outer.parameters(), strict=True):
        assert torch.equal(ours, theirs)


def test_rollout_begins_with_the_body_and_holds_its_clamp(simulator, scene):
    """One frame more than asked for; frame 0 is the input; kinematic particles never move."""
    motion = simulator.rollout(scene.position, scene.velocity, scene.particle_type, frames=4)
    assert motion.frame_count == 5
    assert torch.equal(motion.position[0], scene.position)
    held = motion.position[:, scene.kinematic]
    assert torch.equal(held, held[:1].expand_as(held))
    assert not torch.equal(motion.position[-1], scene.position)
    assert motion.frame_dt == simulator.config.frame_dt


def test_rollout_leaves_its_inputs_as_they_were(simulator, scene):
    """State is never changed in place."""
    arguments = (scene.position, scene.velocity, scene.particle_type)
    before = [value.clone() for value in arguments]
    simulator.rollout(*arguments, frames=2)
    assert all(torch.equal(a, b) for a, b in zip(arguments, before, strict=True))


def test_number_of_samples_is_what_was_asked_for_or_an_error(simulator, scene):
    """More samples than particles is an error, never a cut."""
    count = len(scene.position)
    assert len(simulator.sample(scene.position, count=17)) == 17
    assert len(simulator.sample(scene.position, count=count)) == count
    for wrong in (0, count + 1):
        with pytest.raises(ValueError, match=str(wrong)):
            simulator.sample(scene.position, count=wrong)


def test_body_of_another_dimension_is_refused(simulator, scene):
    """A flat body has no third coordinate to predict."""
    flat = (scene.position[:, :2], scene.velocity[:, :2], scene.particle_type)
    with pytest.raises(ValueError, match=r"2-dimensional.*3 dimensions"):
        simulator.rollout(*flat, frames=1)


def test_stored_form_holds_no_pickle(run_folder):
    """JSON and safetensors alone; neither a pickle's first byte nor a zip archive's."""
    files = [path for path in run_folder.rglob("*") if path.is_file()]
    assert {path.suffix for path in files} == {".json", ".jsonl", ".safetensors"}
    for path in files:
        assert path.read_bytes()[:1] != b"\x80" or path.suffix == ".safetensors"
        if path.suffix == ".safetensors":
            head = path.read_bytes()
            length = int.from_bytes(head[:8], "little")
            assert isinstance(json.loads(head[8 : 8 + length]), dict)


@pytest.mark.parametrize("damage", ["truncated", "missing", "foreign", "scribble"])
def test_damaged_weights_are_refused_in_one_line(stored, damage):
    """The line names the file."""
    file = stored / "model.safetensors"
    content = file.read_bytes()
    file.unlink()
    if damage == "truncated":
        file.write_bytes(content[: len(content) // 2])
    elif damage == "foreign":
        save_file({"weight": torch.ones(3)}, file)
    elif damage == "scribble":
        file.write_bytes(b"nothing of the kind")
    assert "model.safetensors" in refused(stored)


def test_weights_of_another_shape_are_refused(stored):
    """config.json and the weights belong together."""
    edit(stored, lambda record: record["field"]["neural_basis"].update(modes=9))
    assert "does not hold the weights that config.json describes" in refused(stored)


@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_weights_that_are_not_finite_are_refused(stored, value):
    """The line names the tensor."""
    tensors = load_file(stored / "model.safetensors")
    name = min(tensors)
    tensors[name].fill_(value)
    save_file(tensors, stored / "model.safetensors")
    assert f"{name} holds values that are not finite" in refused(stored)


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (lambda record: record.update(format_version=3), "format version 3"),
        (lambda record: record.pop("format_version"), "format version None"),
        (lambda record: record.update(shape=1), "no field 'shape'"),
        (lambda record: record["time_stepper"].update(hiddn=1), "'hidden'"),
        (lambda record: record.update(dimension="three"), "dimension"),
        (lambda record: record.pop("graph"), "graph"),
        (lambda record: record["graph"].update(radius=None), "radius must be set"),
        (lambda record: record["normalization"].update(velocity_std=[1.0, 0.0, 1.0]), "> 0"),
        (lambda record: record.update(dimension=2), "dimension"),
        (lambda record: record.update(bounds=[[0.0, 1.0]]), "bounds"),
        (lambda record: record.update(bounds=[[1.0, 0.0]] * 3), "low < high"),
        (lambda record: record.update(bounds=[[0.0, math.inf]] * 3), "low < high"),
        (lambda record: record.update(bounds=[[0.0, 1.0, 2.0]] * 3), "low < high"),
        (lambda record: record.update(frame_dt=0.0), "frame_dt must be > 0 s"),
        (lambda record: record.update(format_version=True), "format version True"),
    ],
)
def test_foreign_configuration_is_refused_in_one_line(stored, change, text):
    """Later format, unknown keys at any depth, missing groups, impossible or clashing values."""
    edit(stored, change)
    assert text in refused(stored)


@pytest.mark.parametrize("content", [b"[1, 2]", b'"text"', b"{", b"[" * 100_000, b"\xff\xfe\x00"])
def test_configuration_that_is_no_json_object_is_refused(stored, content):
    """Lists and noise, in one line that names the file."""
    (stored / "config.json").write_bytes(content)
    assert "config.json" in refused(stored)


def test_missing_simulator_is_refused(tmp_path):
    """The line says what was looked for."""
    assert "there is no simulator" in refused(tmp_path / "nothing")


def test_radius_has_to_be_chosen_before_a_simulator_is_made(simulator):
    """A preset may leave the radius open, a trained model may not."""
    config: SimulatorConfig = simulator.config
    with pytest.raises(ValueError, match="radius must be set"):
        Simulator(replace(config, graph=replace(config.graph, radius=None)))
