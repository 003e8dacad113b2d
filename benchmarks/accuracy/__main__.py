"""Command line: ``python -m benchmarks.accuracy [--model NAME] [--part PART]``."""

import argparse
import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import torch

from benchmarks.accuracy.discretisation import measure_discretisation
from benchmarks.accuracy.noise_floor import measure_noise_floor
from benchmarks.accuracy.report import write_report
from benchmarks.accuracy.stability import measure_stability
from giorom.cli import main as giorom
from giorom.config import load_experiment
from giorom.data.atomic import write_json
from giorom.evaluation.card import write_card
from giorom.evaluation.catalogue import catalogue, training_cost, update_catalogue
from giorom.evaluation.machine import describe_machine
from giorom.evaluation.paper import paper_values
from giorom.simulator import PRETRAINED, Simulator, pretrained_names

PARTS = ("scores", "stability", "discretisation", "noise_floor")
"""What can be measured; ``discretisation`` is for clamped bodies alone."""


def main(arguments: list[str] | None = None) -> int:
    """Measure, then write the report; 1 if a requirement is not met."""
    options = _parser().parse_args(arguments)
    torch.set_num_threads(options.threads)
    names = options.model or pretrained_names()
    only_presets = options.preset and not (options.model or options.part)
    parts = [] if options.report_only or only_presets else options.part or PARTS
    for name in names:
        for part in parts:
            print(f"{name}: {part}", flush=True)
            _measure(part, name, options)
    for preset in [] if options.report_only else options.preset:
        print(f"{preset}: noise_floor", flush=True)
        _measure("noise_floor", preset, options)
    if options.paper_run:
        _add_paper_run(*options.paper_run, options)
    missed = write_report(options.pretrained, options.out / "accuracy.md", _floors(options.out))
    for line in missed:
        print(line)
    return 1 if missed else 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m benchmarks.accuracy", description=__doc__)
    parser.add_argument("--model", action="append", help="this model only")
    parser.add_argument("--part", action="append", choices=PARTS, help="this part only")
    parser.add_argument(
        "--preset", action="append", default=[], help="noise floor of a preset; alone: nothing else"
    )
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    parser.add_argument("--pretrained", type=Path, default=PRETRAINED, help="folder of the models")
    parser.add_argument("--trajectories", type=int, default=10, help="held-out trajectories")
    parser.add_argument("--floor-trajectories", type=int, default=4)
    parser.add_argument("--scenes", type=int, default=50, help="scenes of long rollouts")
    parser.add_argument("--batch", type=int, default=10, help="scenes rolled out side by side")
    parser.add_argument("--frames", type=int, help="frames of discretisation; by default all")
    parser.add_argument("--jobs", type=int, default=1, help="processes that make held-out data")
    parser.add_argument("--threads", type=int, default=1)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--report-only", action="store_true", help="measure nothing")
    parser.add_argument(
        "--paper-run",
        nargs=3,
        metavar=("MODEL", "RUN", "TRAIN_JSON"),
        help="score a run of the paper-faithful preset beside a model, on the same scenes",
    )
    return parser


def _measure(part: str, name: str, options: argparse.Namespace) -> None:
    """Measure one part of one model and keep it at once."""
    if part == "noise_floor":
        _keep_floor(name, options)
        return
    directory = options.pretrained / name
    if part == "scores":
        path = directory / "metrics.json"
        known = json.loads(path.read_text()) if path.is_file() else {}
        kept = {key: known[key] for key in (*PARTS, "paper_preset") if key in known}
        write_json(path, _scores(directory, options) | kept)
        _describe(directory)
        return
    simulator = Simulator.from_pretrained(directory)
    if part == "discretisation" and simulator.config.scene.family != "clamped":
        return
    if part == "stability":
        simulator = simulator.to(options.device)
        found = measure_stability(simulator, scenes=options.scenes, batch=options.batch)
    else:
        found = measure_discretisation(
            simulator,
            trajectories=options.trajectories,
            frames=options.frames,
            jobs=options.jobs,
            report=lambda line: print(f"  {line}", flush=True),
        )
    _add(directory, part, found)


def _scores(directory: Path, options: argparse.Namespace) -> dict[str, Any]:
    """What ``giorom evaluate --pretrained NAME`` gives, and what stands beside it."""
    scores = _evaluate(directory, options)
    known = {entry["name"]: entry["commands"] for entry in catalogue(options.pretrained)}
    return scores | {
        "paper": paper_values(scores["system"]),
        "training": training_cost(directory),
        "commands": known.get(directory.name, []),
        "machine": describe_machine(),
    }


def _evaluate(model: Path, options: argparse.Namespace) -> dict[str, Any]:
    """Run the command and read its JSON."""
    with tempfile.TemporaryDirectory() as temporary:
        file = Path(temporary) / "scores.json"
        words = ["evaluate", model, "--trajectories", options.trajectories, "--json", file]
        words += ["--jobs", options.jobs, "--threads", options.threads]
        code = giorom([str(word) for word in [*words, "--device", options.device, "--quiet"]])
        if code != 0:
            raise RuntimeError(f"giorom evaluate {model} ended with exit code {code}")
        return json.loads(file.read_text(encoding="utf-8"))


def _add_paper_run(name: str, run: str, training: str, options: argparse.Namespace) -> None:
    """Score a run of the paper-faithful preset on the scenes that the model was scored on.

    Raises:
        ValueError: If the run was trained on other scenes.
    """
    ours, theirs = (
        Simulator.from_pretrained(place).config for place in (options.pretrained / name, run)
    )
    if (ours.scene, ours.solver) != (theirs.scene, theirs.solver):
        raise ValueError(
            f"{run} was trained on other scenes than {name}; an equal comparison needs the same. "
            f"Train the paper's recipe on the model's own preset."
        )
    scores = _evaluate(Path(run), options)
    record = json.loads(Path(training).read_text(encoding="utf-8"))
    cost = {f"training_{key}": record.get(key) for key in ("seconds", "steps")}
    kept = {key: scores[key] for key in ("trajectories", "diverged", "frames")}
    for where in ("sparse", "full"):
        keys = ("one_step_mse", "rollout_mse", "rollout_mse_std")
        found = scores[where] or {}
        kept[where] = {key: found.get(key) for key in keys} if found else None
    _add(options.pretrained / name, "paper_preset", kept | cost)


def _add(directory: Path, key: str, value: Any) -> None:
    """Put one entry into the metrics of a model."""
    path = directory / "metrics.json"
    metrics = json.loads(path.read_text(encoding="utf-8"))
    write_json(path, metrics | {key: value})


def _describe(directory: Path) -> None:
    """Bring the card of a model and its entry in the index up to its metrics."""
    known = {entry["name"]: entry["commands"] for entry in catalogue(directory.parent)}
    commands = known.get(directory.name, [])
    update_catalogue(directory.parent, directory.name, commands)
    if (directory / "training.json").is_file():
        write_card(directory, Simulator.from_pretrained(directory).config, commands)


def _keep_floor(name: str, options: argparse.Namespace) -> None:
    """Measure the noise floor of a model's or preset's scenes and keep it by name."""
    if (options.pretrained / name / "config.json").is_file():
        source: Any = Simulator.from_pretrained(options.pretrained / name).config
    else:
        source = load_experiment(name)
    found = measure_noise_floor(
        source.scene,
        source.solver,
        trajectories=options.floor_trajectories,
        device=options.device,
    )
    options.out.mkdir(parents=True, exist_ok=True)
    write_json(_floor_file(options.out), _floors(options.out) | {name: found})
    if (options.pretrained / name / "metrics.json").is_file():
        _add(options.pretrained / name, "noise_floor", found)


def _floors(out: Path) -> dict[str, Any]:
    path = _floor_file(out)
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def _floor_file(out: Path) -> Path:
    return out / "noise_floor.json"


if __name__ == "__main__":
    sys.exit(main())
