"""What a pretrained model has to show, judged from its numbers and nothing else.

Every requirement gives a row for every model it concerns. A number that was not measured, and a
mean that a diverged rollout has been left out of, do not meet anything.
"""

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

BEYOND_TRIVIAL = 10.0
"""Times below constant velocity, and below holding still."""

BEYOND_ORACLE = 3.0
"""Times below the better of free fall and the frozen-shape oracle, for what flows."""

SWING = 0.1
"""Largest mean deviation of amplitude and of period from the truth."""

DENSER = 1.5
"""Largest rollout error at four times the samples, over that at the trained number."""

FEWEST_TRAJECTORIES = 10
"""Fewest held-out trajectories behind a mean."""

FEWEST_SCENES = 50
"""Fewest scenes of long rollouts."""

FEWEST_HORIZONS = 5.0
"""Shortest of long rollouts, in training trajectories."""

MOST_BYTES = 5_000_000
"""Largest size of the weights of one model."""

EQUAL_TIME = 0.1
"""Share of a model's training time that a peer may have had less; more is to the peer's favour."""

SOLID_FRAMES, FLOW_FRAMES = "100", "200"
"""Frames over which solids and flows are compared with what needs no model."""

SOLIDS = ("stable_neo_hookean", "fixed_corotated", "von_mises_plasticine")
"""Materials whose bodies keep together; all others, and mixtures, flow."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """One requirement of one model."""

    requirement: str
    """What is asked for."""

    value: float | None
    """What was found; none if it was not measured."""

    bound: float
    """What it is compared with."""

    at_most: bool = True
    """Whether the value must not exceed the bound; else it must reach it."""

    unsound: str = ""
    """Why the value cannot count, such as rollouts that diverged."""

    remark: str = ""
    """What has to be known to read it."""

    @property
    def met(self) -> bool:
        """Whether it is met; what is unknown or unsound is not."""
        if self.value is None or self.unsound or math.isnan(self.value):
            return False
        return self.value <= self.bound if self.at_most else self.value >= self.bound

    @property
    def word(self) -> str:
        """The outcome in words."""
        if self.met:
            return "met"
        if self.value is None and not self.unsound:
            return "not measured"
        return "not met"

    @property
    def asked(self) -> str:
        """The bound in words."""
        return f"{'<=' if self.at_most else '>='} {self.bound:g}"


def is_solid(scene: dict[str, Any]) -> bool:
    """Whether the bodies of a scene family keep together."""
    return scene["material"] in SOLIDS and not scene.get("mixture")


def verdicts(metrics: dict[str, Any], *, scene: dict[str, Any], size: int) -> list[Verdict]:
    """All requirements of a model.

    Args:
        metrics: Contents of its ``metrics.json``.
        scene: Its scene family, as stored in ``config.json``.
        size: Bytes of its weights.
    """
    return [*_scores(metrics, scene), *_others(metrics, scene, size)]


def _scores(metrics: dict[str, Any], scene: dict[str, Any]) -> Iterator[Verdict]:
    """Requirements on the scores of the held-out set."""
    diverged = metrics["diverged"]
    unsound = f"{diverged} of {metrics['trajectories']} rollouts diverged" if diverged else ""
    yield from _against_paper(metrics, unsound)
    yield from _against_trivial(metrics, scene, unsound)
    if scene["family"] == "clamped":
        for name in ("amplitude", "period"):
            yield Verdict(
                requirement=f"{name} of the swing, mean deviation",
                value=_of(metrics, "full", f"swing_{name}_deviation"),
                bound=SWING,
                unsound=unsound,
            )
    yield Verdict(
        requirement="held-out trajectories",
        value=float(metrics["trajectories"]),
        bound=FEWEST_TRAJECTORIES,
        at_most=False,
    )


def _against_paper(metrics: dict[str, Any], unsound: str) -> Iterator[Verdict]:
    """The paper's own errors, where it has the system."""
    paper = metrics.get("paper") or {}
    for label, where, key in (
        ("rollout MSE on the samples at most Table 3", "sparse", "sparse_rollout_mse"),
        ("rollout MSE on all particles at most Table 1", "full", "rollout_mse"),
    ):
        if paper.get(key) is not None:
            yield Verdict(
                requirement=label,
                value=_of(metrics, where, "rollout_mse"),
                bound=paper[key],
                unsound=unsound,
                remark=_likeness(metrics, paper, where, paper[key]),
            )


def _against_trivial(
    metrics: dict[str, Any], scene: dict[str, Any], unsound: str
) -> Iterator[Verdict]:
    """How far below predictions without a model."""

    def at_least(text: str, times: float, find: Callable[[str], float | None]) -> Verdict:
        found = [find(where) for where in ("sparse", "full")]
        known = [value for value in found if value is not None]
        value = min(known) if len(known) == len(found) else None
        text = f"{text}, at least {times:g} times below"
        return Verdict(requirement=text, value=value, bound=times, at_most=False, unsound=unsound)

    yield at_least(
        "constant velocity, all frames",
        BEYOND_TRIVIAL,
        lambda where: _over(metrics, where, ["constant_velocity"], None),
    )
    solid = is_solid(scene)
    frame = SOLID_FRAMES if solid else FLOW_FRAMES
    yield at_least(
        f"holding still, {frame} frames",
        BEYOND_TRIVIAL,
        lambda where: _over(metrics, where, ["static"], frame),
    )
    if not solid:
        yield at_least(
            f"the better of free fall and frozen shape, {frame} frames",
            BEYOND_ORACLE,
            lambda where: _over(metrics, where, ["ballistic_clamped", "frozen_shape"], frame),
        )


TRIVIAL = {
    "static": "holding still",
    "constant_velocity": "constant velocity",
    "ballistic_clamped": "free fall",
    "frozen_shape": "the frozen-shape oracle",
}
"""What needs no model, and its names."""


def _likeness(metrics: dict[str, Any], paper: dict[str, Any], where: str, bound: float) -> str:
    """How far a comparison with the paper is one of equals, and who else would win it."""
    text = (
        f"ours: {metrics['frames']} frames, {metrics['sparse_points']} of {metrics['points']} "
        f"particles; paper's: {paper['frames']}, {paper['sparse_points']} of {paper['points']}"
    )
    found = {name: _of(metrics, where, f"{key}_mse") for key, name in TRIVIAL.items()}
    also = [name for name, value in found.items() if value is not None and value <= bound]
    return f"{text}; {', '.join(also)} would do" if also else text


def _others(metrics: dict[str, Any], scene: dict[str, Any], size: int) -> Iterator[Verdict]:
    """Requirements on what is measured beside the scores."""
    yield _stability(metrics.get("stability"))
    if scene["family"] == "clamped":
        yield _discretisation(metrics.get("discretisation"))
    yield _against_paper_preset(metrics)
    yield Verdict(requirement="bytes of the weights", value=float(size), bound=MOST_BYTES)


def _stability(found: dict[str, Any] | None) -> Verdict:
    unsound = ""
    if found and (found["scenes"] < FEWEST_SCENES or found["horizons"] < FEWEST_HORIZONS):
        unsound = f"only {found['scenes']} scenes over {found['horizons']:g} horizons"
    return Verdict(
        requirement=f"rollouts lost of {FEWEST_SCENES} over {FEWEST_HORIZONS:g} training horizons",
        value=None if found is None else float(found["lost"]),
        bound=0.0,
        unsound=unsound,
    )


def _discretisation(found: dict[str, Any] | None) -> Verdict:
    rows = [] if found is None else [row for row in found["rows"] if row["factor"] == 4.0]
    unsound = ""
    if rows and rows[0]["ratio"] is None:
        unsound = "a rollout diverged"
    elif rows and rows[0]["trajectories"] < FEWEST_TRAJECTORIES:
        unsound = f"only {rows[0]['trajectories']} trajectories"
    return Verdict(
        requirement="rollout error at 4 times the samples over that at the trained number",
        value=rows[0]["ratio"] if rows else None,
        bound=DENSER,
        unsound=unsound,
    )


def _against_paper_preset(metrics: dict[str, Any]) -> Verdict:
    """Rollout error over that of the paper-faithful preset, trained as long."""
    other = metrics.get("paper_preset")
    value, unsound = None, ""
    if other is not None:
        ours, theirs = _of(metrics, "full", "rollout_mse"), _of(other, "full", "rollout_mse")
        times = metrics.get("training", {}).get("seconds"), other.get("training_seconds")
        if other["diverged"] == other["trajectories"]:
            theirs = math.inf
        value = None if ours is None or not theirs else ours / theirs
        if None in times or times[1] < (1.0 - EQUAL_TIME) * times[0]:
            unsound = f"training took {times[0]} s and {times[1]} s"
    return Verdict(
        requirement="rollout MSE over that of the paper-faithful preset, equal training time",
        value=value,
        bound=1.0,
        unsound=unsound,
    )


def _of(metrics: dict[str, Any], where: str, key: str) -> float | None:
    """A mean score; none where all rollouts diverged or it was not measured."""
    return (metrics.get(where) or {}).get(key)


def _over(metrics: dict[str, Any], where: str, names: list[str], frame: str | None) -> float | None:
    """The smallest of some errors without a model over that of the model."""
    scores = metrics.get(where) or {}
    if frame is None:
        own, others = scores.get("rollout_mse"), [scores.get(f"{name}_mse") for name in names]
    else:
        own = scores.get("rollout_mse_at", {}).get(frame)
        others = [scores.get(f"{name}_mse_at", {}).get(frame) for name in names]
    if own is None or None in others:
        return None
    return min(others) / own if own else math.inf
