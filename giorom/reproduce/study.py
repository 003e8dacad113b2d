"""What the tables share: data sets, trained models, scores and other small results, each made once.

Everything lies below ``OUT/shared`` under a name that ends in a hash of all it depends on, and is
put in place whole: a process that is killed at any moment leaves nothing that a later one would
take for finished, and the same command goes on from there.
"""

import hashlib
import json
import re
from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass, field, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

from giorom.config import Experiment, load_experiment, merged
from giorom.data.atomic import write_json
from giorom.data.trajectory_file import trajectory_count
from giorom.evaluation.fresh_process import call_afresh
from giorom.generate import generate
from giorom.records import nearest
from giorom.reproduce.methods import METHODS
from giorom.reproduce.scale import Scale
from giorom.reproduce.trial import Trial, finite, identity_of, score_run, train_trial, unscored
from giorom.reproduce.workers import Task, one_thread, run_tasks
from giorom.training.training_config import Budget
from giorom.version import __version__

WORTH_PROCESSES = 8
"""Trajectories for which it pays to start processes."""

Report = Callable[[str, int, int], None]
"""Called with what is done now, how many tasks have ended and how many there are."""


def quiet(text: str, done: int, total: int) -> None:
    """No progress."""
    del text, done, total


@dataclass(frozen=True, kw_only=True)
class Study:
    """One scale, one folder, one device."""

    scale: Scale
    """How large everything is."""

    out: Path
    """Folder of the results; ``shared`` below it holds what they are made of."""

    seed: int = 0
    """Seed of the first training of each method."""

    device: str = "cpu"
    """Where networks are trained."""

    jobs: int = 1
    """Processes."""

    report: Report = quiet
    """Progress."""

    used: dict[str, dict[str, Any]] = field(default_factory=dict, repr=False)
    """Trainings that results have been asked of, by key: what a table says about its cost."""

    @property
    def seeds(self) -> list[int]:
        """Seeds of the trainings of a method."""
        return list(range(self.seed, self.seed + self.scale.seeds))

    @property
    def shared(self) -> Path:
        """Where data sets, models and scores are kept."""
        return self.out / "shared"

    def experiment(
        self, system: str, method: str = "default", changes: dict[str, Any] | None = None
    ) -> Experiment:
        """The preset of a system with the recipes of a method, the scale's values and ``changes``.

        Args:
            system: Physical system.
            method: Name in ``METHODS``.
            changes: Nested values that come last.
        """
        made, chosen = self._system(system), _method(method)
        values = made.changes
        if chosen.is_network:
            values = merged(values, self.scale.networks)
        else:
            values = merged(values, made.own)
        name = "+".join((made.preset, *chosen.recipes))
        return _loaded(name, json.dumps(merged(values, changes or {}), sort_keys=True))

    def dataset(self, system: str) -> Path:
        """The data set of a system, made if it is not there."""
        return self.dataset_of(
            self.experiment(system), trajectories=self._system(system).trajectories
        )

    def dataset_of(
        self,
        experiment: Experiment,
        *,
        trajectories: int,
        seed: int = 0,
        shape: str | None = None,
    ) -> Path:
        """A data set of some scenes, made if it is not there.

        Args:
            experiment: Scenes and solver.
            trajectories: How many.
            seed: Seed of the scenes; data for training have 0.
            shape: Shape in place of the drawn ones.
        """
        scenes: dict[str, Any] = {"trajectories": trajectories, "seed": seed, "shape": shape}
        folder = self.shared / "data" / self._data_key(experiment, **scenes)
        done = folder.with_name(f"{folder.name}.json")
        if done.is_file() and (folder / "metadata.json").is_file():
            return folder
        made = generate(
            experiment,
            folder=folder,
            jobs=self.jobs if trajectories >= WORTH_PROCESSES else 1,
            device="cpu",
            report=partial(self.report, f"simulate {experiment.system}"),
            **scenes,
        )
        write_json(done, made)
        return folder

    def trained(
        self,
        system: str,
        method: str,
        *,
        seed: int | None = None,
        changes: dict[str, Any] | None = None,
        budget: Budget | None = None,
    ) -> Path | None:
        """Folder of a training run, for ``Simulator.from_pretrained``; trained if need be.

        None if every validation rollout diverged.
        """
        trial = Trial(
            system=system,
            method=method,
            seed=self.seed if seed is None else seed,
            changes=changes or {},
            budget=budget,
        )
        return self.run_of(trial)

    def run_of(self, trial: Trial) -> Path | None:
        """The same for a trial."""
        record = self.training(trial)
        return None if record["problem"] is not None else self.folder(trial) / "run"

    def training(self, trial: Trial) -> dict[str, Any]:
        """What is known of a training: steps, seconds, parameters, best validation, problem."""
        folder = self.folder(trial)
        record = _read(folder / "trained.json")
        if record is None:
            data = self.dataset(trial.system)
            write_json(folder / "trial.json", self._identity(trial))
            record = train_trial(
                self._experiment_of(trial),
                data=data,
                folder=folder,
                budget=self._budget(trial),
                seed=trial.seed,
                device=self.device,
            )
        self.used[folder.name] = {
            "system": trial.system,
            "method": trial.method,
            "seed": trial.seed,
            **{name: record[name] for name in ("seconds", "steps", "parameters", "problem")},
        }
        return record

    def scores(
        self,
        trial: Trial,
        *,
        sparse_points: int | None = None,
        frames: int | None = None,
        where: str = "test",
        full: bool = True,
    ) -> dict[str, Any]:
        """Scores of a trained model: ``evaluation.summarize``, and what the training took.

        Args:
            trial: The training; made if need be.
            sparse_points: Number of samples; by default as trained.
            frames: Frames to predict; by default all there are.
            where: Split of the data set.
            full: Whether all particles are recovered and scored, and single steps; three quarters
                of the work.
        """
        record = self.training(trial)
        options = _score_options(sparse_points=sparse_points, frames=frames, where=where, full=full)
        if not full and self._has_scores(trial, options | {"full": True}):
            options["full"] = True
        data = self.dataset(trial.system)

        def make() -> dict[str, Any]:
            if record["problem"] is not None:
                return unscored(record, trajectory_count(data, where))
            run = self.folder(trial) / "run"
            return score_run(run, data, device=self.device, **options)

        found = self.kept("scores", {"trial": self.folder(trial).name, **options}, make)
        kept = ("steps", "seconds", "parameters", "best_rollout_mse", "radius", "problem")
        known = {name: record[name] for name in kept}
        return found | known | {"trial": self.folder(trial).name}

    def train_all(self, trials: Iterable[Trial], *, score: bool = True, full: bool = True) -> None:
        """Train, and score on the test split, whatever of the trials is missing.

        Args:
            trials: The trainings; repeated ones are made once.
            score: Whether they are scored too.
            full: Whether the scores are those of all particles too, as in ``scores``.
        """
        wanted = {self.folder(trial).name: trial for trial in trials}
        for system in dict.fromkeys(trial.system for trial in wanted.values()):
            self.dataset(system)
        missing = [
            trial for trial in wanted.values() if not self._is_done(trial, score=score, full=full)
        ]
        self.work(
            [(_train_and_score, (self._plain(), trial, score, full)) for trial in missing],
            names=[f"{t.system} {t.method}, seed {t.seed}" for t in missing],
        )
        for trial in wanted.values():
            self.training(trial)  # so that the result knows what it cost

    def kept(self, name: str, key: dict[str, Any], make: Callable[[], Any]) -> Any:
        """A small result, made once.

        Args:
            name: What it is; part of the file's name.
            key: All it depends on but the version of the package, as JSON values.
            make: Makes it, as JSON values.
        """
        path = self._kept_path(name, key)
        known = _read(path)
        if known is None:
            known = {"name": name, "key": key, "value": finite(make())}
            write_json(path, known)
        return known["value"]

    def kept_all(
        self,
        name: str,
        keys: list[dict[str, Any]],
        make: Callable[["Study", dict[str, Any]], Any],
    ) -> list[Any]:
        """The same for several keys, in ``jobs`` processes.

        Args:
            name: What they are.
            keys: All each of them depends on.
            make: Function of a module that makes one, from the study and the key.
        """
        missing = [key for key in keys if not self._kept_path(name, key).is_file()]
        self.work(
            [(_keep_one, (self._plain(), name, key, make)) for key in missing],
            names=[name] * len(missing),
        )
        return [self.kept(name, key, partial(make, self, key)) for key in keys]

    def alone(self, measure: Callable[[Any], Any], case: Any) -> Any:
        """A measurement of time or memory, in a process of its own if the scale says so.

        Args:
            measure: Function of a module.
            case: What it measures.
        """
        if self.scale.alone:
            return call_afresh(measure, case)
        with one_thread():
            return measure(case)

    def work(self, tasks: list[Task], *, names: list[str]) -> None:
        """Work off tasks in ``jobs`` processes; each leaves what it makes in files."""

        def done(number: int) -> None:
            ended.append(number)
            self.report(names[number], len(ended), len(tasks))

        ended: list[int] = []
        if tasks:
            self.report(names[0], 0, len(tasks))
        run_tasks(tasks, jobs=self.jobs, done=done)

    def folder(self, trial: Trial) -> Path:
        """Where a training is kept."""
        label = f"{trial.system}-{trial.method}-{trial.seed}"
        return self.shared / "models" / f"{label}-{_hash(self._identity(trial))}"

    def _identity(self, trial: Trial) -> dict[str, Any]:
        system = self._system(trial.system)
        return identity_of(
            self._experiment_of(trial),
            data_key=self._data_key(
                self.experiment(trial.system), trajectories=system.trajectories
            ),
            budget=self._budget(trial),
            seed=trial.seed,
            device=self.device,
        )

    def _experiment_of(self, trial: Trial) -> Experiment:
        return self.experiment(trial.system, trial.method, trial.changes)

    def _budget(self, trial: Trial) -> Budget:
        return self.scale.budget if trial.budget is None else trial.budget

    def _system(self, system: str) -> Any:
        if system not in self.scale.systems:
            known = list(self.scale.systems)
            raise ValueError(f"there is no system {system!r}. {nearest(system, known)}")
        return self.scale.systems[system]

    def _is_done(self, trial: Trial, *, score: bool, full: bool) -> bool:
        folder = self.folder(trial)
        if not (folder / "trained.json").is_file():
            return False
        asked = [_score_options(full=True), _score_options(full=full)]
        return not score or any(self._has_scores(trial, options) for options in asked)

    def _has_scores(self, trial: Trial, options: dict[str, Any]) -> bool:
        key = {"trial": self.folder(trial).name, **options}
        return self._kept_path("scores", key).is_file()

    def _kept_path(self, name: str, key: dict[str, Any]) -> Path:
        safe = re.sub(r"[^A-Za-z0-9-]", "-", name)
        known = {"key": key, "scale": self.scale.name, "giorom": __version__}
        return self.shared / "kept" / f"{safe}-{_hash(known)}.json"

    def _data_key(
        self, experiment: Experiment, *, trajectories: int, seed: int = 0, shape: str | None = None
    ) -> str:
        content = {
            "scene": asdict(experiment.scene),
            "solver": asdict(experiment.solver),
            "trajectories": trajectories,
            "seed": seed,
            "shape": shape,
            "giorom": __version__,
        }
        return f"{experiment.system}-{_hash(content)}"

    def _plain(self) -> "Study":
        """The same study for another process: alone and silent."""
        return replace(self, jobs=1, report=quiet, used={})


@lru_cache(maxsize=1024)
def _loaded(name: str, overrides: str) -> Experiment:
    """An experiment by its name and its overrides as JSON; reading one takes a while."""
    return load_experiment(name, json.loads(overrides))


def _train_and_score(study: Study, trial: Trial, score: bool, full: bool) -> None:
    if score:
        study.scores(trial, full=full)
    else:
        study.training(trial)


def _keep_one(
    study: Study, name: str, key: dict[str, Any], make: Callable[[Study, dict[str, Any]], Any]
) -> None:
    study.kept(name, key, partial(make, study, key))


def _score_options(
    *,
    sparse_points: int | None = None,
    frames: int | None = None,
    where: str = "test",
    full: bool = True,
) -> dict[str, Any]:
    """How a model is scored; part of the key under which the scores are kept."""
    return {"sparse_points": sparse_points, "frames": frames, "where": where, "full": full}


def _method(name: str) -> Any:
    if name not in METHODS:
        raise ValueError(f"there is no method {name!r}. {nearest(name, METHODS)}")
    return METHODS[name]


def _hash(content: dict[str, Any]) -> str:
    text = json.dumps(content, sort_keys=True, default=str)
    return hashlib.sha256(text.encode()).hexdigest()[:12]


def _read(path: Path) -> dict[str, Any] | None:
    """A finished JSON file; none if there is none."""
    if not path.is_file():
        return None
    return json.loads(path.read_text(encoding="utf-8"))
