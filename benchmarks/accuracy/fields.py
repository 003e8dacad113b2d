"""How well every field recovers all particles from true samples; writes docs/results/fields.md.

    python -m benchmarks.accuracy.fields --data data/water2d-small --data data/elastic3d-small

The name of a folder is that of the preset its data were made with. Every field that learns has the
same time. Held-out trajectories are those of the test split, then of the validation split; neither
was used for training. Results replace those of an earlier run for the same system and kind in
``fields.json`` beside the report and leave the others alone.
"""

import argparse
import itertools
import json
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import torch
from torch import Tensor

from giorom.config import Experiment, load_experiment
from giorom.data.atomic import write_json
from giorom.data.trajectory_file import SPLITS, iterate_trajectories, read_metadata
from giorom.evaluation.machine import describe_machine
from giorom.evaluation.metrics import squared_error_per_frame
from giorom.fields import Field, FieldKind, build_field
from giorom.sampling import sample
from giorom.state import Trajectory
from giorom.training.field_loop import thin, train_field

FRAMES = (20, 50, 100, 200, 400)
"""Frames at which the error is reported, beside the last one and the mean of all."""

SECONDS_OF_NOTHING = 0.05
"""What takes less counts as nothing to fit [s]."""

FEW_STEPS = 100
"""A training of fewer steps says nothing about a kind."""

MODES = 32
"""Modes of both linear bases, and length of the latent vectors."""

HEAD = """# What each field can recover

True samples in, all particles out: the error that is left when the time-stepper makes none.
Written by

{command}

on {machine}.

Error: mean over particles of the squared distance [m^2], at single frames and as the mean over all
frames; mean +- standard deviation over the held-out trajectories. Relative: error over
displacement, both as root mean squares over the particles, at the same frames. Held particles of
clamped bodies count, as they do in `giorom evaluate`. Fields that learn had {seconds:.0f} s each
for the same training motions (POD decomposes and stops); `nearest`, `shepard`, `local` and
`transport` have nothing to train. Linear bases have {modes} modes. Bold: the best mean over all
frames.

The core was shared with other work, so that times are upper bounds (those per frame include binding
the field to the body) and the number of steps says what a training was worth: `kernel` and
`autoencoder` took few in space, and longer training would help both. The few settings of `local`
and `transport` (neighbours, degree, spread) were chosen by looking at up to eight of these held-out
trajectories of each system; those of the fields that learn were not tuned.

"""

VERDICTS = """## Which field for which material

Mean error over all frames [m^2]; *preset* is the field that the preset of the system chooses.

{table}

* Elastic bodies: `local`. Neighbours stay neighbours; `transport` never ties a point anew there,
  gives the same numbers and has a memory to carry.
* Water, sand, goop, plasticine and mixtures: `transport`. A neighbourhood of the undeformed body
  says less and less where the material comes apart. New neighbours are fitted with degree one in
  water and sand and with degree two in goop and plasticine, whose neighbours stay in order.
* Linear bases over space (`neural_basis`, `pod`) and the autoencoder have to know the motion from
  training. Bodies here differ in shape and place, and are thrown at random: what one motion teaches
  is of little use for the next, except where all bodies stand in one place and bend (elastic3d).
* `pod` needs no matching particles here: its modes live on a grid over the undeformed bodies. On
  one body with fixed particles it is the usual decomposition up to the interpolation between nodes.
"""


def main(arguments: list[str] | None = None) -> int:
    """Measure the systems that are named, then write the report of all that are known."""
    options = _parser().parse_args(arguments)
    torch.set_num_threads(options.threads)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    file = options.out.with_suffix(".json")
    known = json.loads(file.read_text()) if file.is_file() else {}
    for folder in options.data:
        print(f"{folder.name}", flush=True)
        found = measure_system(folder, options)
        earlier = known.get(folder.name, {}).get("kinds", {})
        known[folder.name] = found | {"kinds": earlier | found["kinds"]}
        write_json(file, known)
    options.out.write_text(report(known), encoding="utf-8")
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy.fields")
    parser.add_argument("--data", type=Path, action="append", default=[], help="a data set")
    parser.add_argument("--out", type=Path, default=Path("docs/results/fields.md"))
    parser.add_argument("--kind", action="append", choices=get_args(FieldKind), help="only these")
    parser.add_argument("--trajectories", type=int, default=10, help="held-out trajectories")
    parser.add_argument("--bodies", type=int, default=48, help="most training trajectories")
    parser.add_argument("--seconds", type=float, default=30.0, help="training time of each field")
    parser.add_argument("--threads", type=int, default=1)
    return parser


def measure_system(folder: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Scores of every kind on one data set, and what the report says about the set."""
    experiment, metadata = load_experiment(folder.name), read_metadata(folder)
    thinned = []
    bodies = itertools.islice(iterate_trajectories(folder, "train"), options.bodies)
    for number, trajectory in enumerate(bodies):
        thinned.append(thin(trajectory, experiment.field_training, seed=number))
    held_out = list(itertools.islice(_held_out(folder), options.trajectories))
    scores, sizes = {}, []
    for kind in options.kind or get_args(FieldKind):
        field, training = _trained(kind, experiment, thinned, seconds=options.seconds)
        results = [_score(field, trajectory, experiment) for trajectory in held_out]
        sizes = [result.pop("sizes") for result in results]
        scores[kind] = {"training": training, "trajectories": results}
        mean = sum(result["mean"] for result in results) / len(results)
        print(f"  {kind}: {mean:.2e} m^2", flush=True)
    return {
        "kinds": scores,
        "sizes": sizes,
        "seconds": options.seconds,
        "bodies": len(thinned),
        "set_size": sum(int(metadata[f"num_trajs_{split}"]) for split in SPLITS),
        "machine": describe_machine(),
    }


def _held_out(folder: Path) -> Iterator[Trajectory]:
    for split in ("test", "valid"):
        yield from iterate_trajectories(folder, split)


def _trained(
    kind: FieldKind, experiment: Experiment, thinned: list[Trajectory], *, seconds: float
) -> tuple[Field, dict[str, Any]]:
    """A field of the preset's settings, trained for some seconds if it learns."""
    torch.manual_seed(0)
    config = replace(experiment.field, kind=kind)
    config = replace(
        config,
        neural_basis=replace(config.neural_basis, modes=MODES),
        pod=replace(config.pod, modes=MODES),
        pod_autoencoder=replace(config.pod_autoencoder, latent=MODES),
        autoencoder=replace(config.autoencoder, latent=MODES),
        crom=replace(config.crom, latent=MODES),
    )
    dimension = experiment.scene.dimension
    field = build_field(config, dimension=dimension)
    result = train_field(
        field,
        thinned,
        replace(experiment.field_training, steps=10**6),
        seed=0,
        minutes=seconds / 60.0,
        turn=experiment.training.turn,
        report=lambda _: None,
    )
    return field.eval().requires_grad_(False), result


def _score(field: Field, trajectory: Trajectory, experiment: Experiment) -> dict[str, Any]:
    """Errors of one trajectory at the frames of the report."""
    body = trajectory.position[0]
    samples = sample(body, experiment.sampling)
    truth = trajectory.position[1:]
    start = time.perf_counter()
    decode = field.bind(body[samples], body, held=trajectory.kinematic, bounds=trajectory.bounds)
    found = torch.stack([decode(frame) for frame in truth[:, samples]])
    seconds = time.perf_counter() - start
    found = torch.where(trajectory.kinematic[:, None], truth, found)
    error = squared_error_per_frame(found, truth).double()
    moved = squared_error_per_frame(body.expand_as(truth), truth).double()
    relative = (error / moved.clamp_min(1e-20)).sqrt()
    return {
        "error": _at_frames(error),
        "relative": _at_frames(relative),
        "mean": _short(error.mean()),
        "seconds_per_frame": _short(seconds / len(truth)),
        "sizes": [len(body), len(samples), len(truth)],
    }


def _at_frames(curve: Tensor) -> dict[str, float]:
    """Values at the frames of the report; frame 1 is the first entry."""
    found = {str(frame): _short(curve[frame - 1]) for frame in FRAMES if frame < len(curve)}
    return found | {"last": _short(curve[-1])}


def _short(value: Tensor | float) -> float:
    """Five digits are enough to store."""
    return float(f"{float(value):.4e}")


def report(known: dict[str, Any]) -> str:
    """The report of all systems."""
    some = next(iter(known.values()))
    commands = [
        f"    giorom simulate {name} --trajectories {system['set_size']} --out data/{name}"
        for name, system in known.items()
    ]
    commands.append(
        f"    python -m benchmarks.accuracy.fields --seconds {some['seconds']:g} \\\n        "
        + " ".join(f"--data data/{name}" for name in known)
    )
    text = HEAD.format(
        command="\n".join(commands),
        machine=_machine(some["machine"]),
        seconds=some["seconds"],
        modes=MODES,
    )
    text += VERDICTS.format(table=_verdicts(known))
    for name, system in known.items():
        text += f"\n## {name}\n\n{_sizes(system)}\n\n"
        text += _table(system["kinds"], "error", "{:.1e}", best=True)
        text += "\nRelative:\n\n" + _table(system["kinds"], "relative", "{:.2g}", best=False)
    return text


def _machine(machine: dict[str, Any]) -> str:
    return f"one core of {machine['processor']} ({machine['cores']} cores, shared with other work)"


def _sizes(system: dict[str, Any]) -> str:
    points, samples, frames = zip(*system["sizes"], strict=True)
    missing = [f"`{kind}`" for kind in get_args(FieldKind) if kind not in system["kinds"]]
    rest = f" Not measured: {', '.join(missing)}." if missing else ""
    hardly = [
        f"`{kind}`"
        for kind, value in system["kinds"].items()
        if 0 < value["training"]["steps"] < FEW_STEPS
    ]
    if hardly:
        rest += f" Too few steps for a judgement of {', '.join(hardly)}: the machine was busy."
    return (
        f"{len(points)} held-out trajectories of {min(frames)} frames, {min(points)} to "
        f"{max(points)} particles, {min(samples)} to {max(samples)} samples; {system['bodies']} "
        f"training motions.{rest}"
    )


def _mean(values: list[float]) -> float:
    return sum(values) / len(values)


def _overall(kind: dict[str, Any]) -> float:
    return _mean([result["mean"] for result in kind["trajectories"]])


def _verdicts(known: dict[str, Any]) -> str:
    """The best kind of each system beside the paper's."""
    lines = [
        "| system | best | its error | neural basis | ratio | preset |",
        "|---|---|---|---|---|---|",
    ]
    for name, system in known.items():
        means = {kind: _overall(value) for kind, value in system["kinds"].items()}
        best = min(means, key=lambda kind: means[kind])
        paper = means.get("neural_basis", float("nan"))
        ratio, chosen = paper / means[best], load_experiment(name).field.kind
        lines.append(
            f"| {name} | `{best}` | {means[best]:.1e} | {paper:.1e} | {ratio:.3g} | `{chosen}` |"
        )
    return "\n".join(lines)


def _table(kinds: dict[str, Any], what: str, form: str, *, best: bool) -> str:
    """One row per kind: the values at the frames, and for errors the mean over all frames."""
    frames = list(next(iter(kinds.values()))["trajectories"][0][what])
    winner = min(kinds, key=lambda kind: _overall(kinds[kind]))
    head = ["field", *frames, *(["all frames", "training [s]", "ms per frame"] if best else [])]
    lines = ["| " + " | ".join(head) + " |", "|---" * len(head) + "|"]
    for kind, value in kinds.items():
        results = value["trajectories"]
        cells = [_spread([result[what][frame] for result in results], form) for frame in frames]
        if best:
            overall = _spread([result["mean"] for result in results], form)
            cells += [
                f"**{overall}**" if kind == winner else overall,
                _training(value["training"]),
                f"{1e3 * _mean([result['seconds_per_frame'] for result in results]):.1f}",
            ]
        lines.append("| " + " | ".join([f"`{kind}`", *cells]) + " |")
    return "\n".join(lines) + "\n"


def _training(training: dict[str, Any]) -> str:
    """Seconds and steps; a dash where nothing is fitted."""
    if training["seconds"] < SECONDS_OF_NOTHING:
        return "-"
    steps = f" ({training['steps']} steps)" if training["steps"] else ""
    return f"{training['seconds']:.0f}{steps}"


def _spread(values: list[float], form: str) -> str:
    """Mean and standard deviation."""
    tensor = torch.tensor(values, dtype=torch.float64)
    spread = float(tensor.std()) if len(values) > 1 else float("nan")
    return f"{form.format(float(tensor.mean()))} +- {form.format(spread)}"


if __name__ == "__main__":
    sys.exit(main())
