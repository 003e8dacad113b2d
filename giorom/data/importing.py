"""Make a data set of somebody else's motions, frame by frame, whole or not at all.

Everything is written into a temporary folder beside the wanted one: each trajectory to a part as
its frames come, measured on the way; then the walls, which may only now be known; then the split
files, the metadata and the report. The folder is put in place at the very end. Memory holds a few
frames, whatever the size of the source.
"""

import json
from collections.abc import Callable, Iterable, Iterator
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.atomic import replacing_folder, write_json
from giorom.data.conversion import Conversion, converted
from giorom.data.import_checks import check_like, checked_frames
from giorom.data.measure import MotionSummary, SetMeasure
from giorom.data.metadata import DataError
from giorom.data.readers.source import ForeignTrajectory
from giorom.data.report import Origin, Report, make_report
from giorom.data.report_text import markdown
from giorom.data.statistics import StatisticsAccumulator
from giorom.data.trajectory_file import SPLITS, attributes_text
from giorom.data.trajectory_writer import open_trajectory_writer
from giorom.data.work_folder import assemble_dataset, open_work_folder, part_path, split_parts
from giorom.state import KINEMATIC

__all__ = ["ImportOptions", "Progress", "import_trajectories", "measure_trajectories"]

Progress = Callable[[str, int], None]
"""Called with the name of the trajectory being read and the number of frames since last time."""

RADIUS_SHARE = 0.1
"""Radius in the metadata, in parts of the largest extent, where the particles tell none."""


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """What is imported, and how it is divided."""

    conversion: Conversion = field(default_factory=Conversion)
    """Units, axes, frames."""

    shares: tuple[float, float] | None = None
    """Shares for validation and test, in place of what the source says."""

    frozen_kinematic: bool = False
    """Give particles that never move the kinematic type; every motion is read twice for it."""

    drop_bad: bool = False
    """Leave trajectories out that are damaged, not finite or unlike the first, and what follows
    where the source itself breaks off, instead of refusing the source."""

    limit: int | None = None
    """Most trajectories to take."""

    def __post_init__(self) -> None:
        """Reject what nothing can be imported with."""
        if self.limit is not None and self.limit < 1:
            raise DataError(f"--limit must be >= 1, got {self.limit!r}.")
        if self.shares is not None:
            split_parts([], valid_share=self.shares[0], test_share=self.shares[1])


@dataclass(kw_only=True)
class _Progressing:
    """What has been done of an import."""

    folder: Path
    """The temporary folder."""
    options: ImportOptions
    progress: Progress
    measure: SetMeasure = field(default_factory=SetMeasure)
    dropped: list[str] = field(default_factory=list)
    unread: list[str] = field(default_factory=list)
    """Why the rest of the source could not be read."""
    complete: bool = True


def measure_trajectories(
    source: Iterable[ForeignTrajectory],
    *,
    conversion: Conversion,
    limit: int | None = None,
    progress: Progress,
) -> tuple[SetMeasure, bool]:
    """Look at every frame of a source without keeping it.

    Args:
        source: The motions as their reader gives them.
        conversion: Units, axes, frames.
        limit: Most trajectories to look at.
        progress: Told of every frame.

    Returns:
        What was measured, and whether it is all of the source.

    Raises:
        DataError: If the source is damaged or holds no motion.
    """
    measure, complete = SetMeasure(), conversion.stride == 1 and conversion.skip == 0
    for number, foreign in enumerate(source):
        if limit is not None and number >= limit:
            complete = False
            break
        motion = converted(foreign, conversion)
        check_like(motion, measure.motions, frame_dt_needed=False)
        gauge = measure.begin(motion.name, motion.particle_type, motion.bounds)
        for frame in checked_frames(motion, measure.motions, finite=False):
            gauge.add(frame)
            progress(motion.name, 1)
        gauge.finish(
            split=motion.split,
            frame_dt=motion.frame_dt,
            identity_kept=motion.identity_kept,
            notes=motion.notes,
        )
    if not measure.motions:
        raise DataError("the source holds no trajectory. Check the path, or name the --format.")
    return measure, complete


def import_trajectories(
    source: Iterable[ForeignTrajectory],
    folder: Path,
    *,
    options: ImportOptions,
    origin: Origin,
    progress: Progress,
) -> Report:
    """Write a data set of the motions of a source.

    Args:
        source: The motions as their reader gives them.
        folder: The data set; must not exist or be empty.
        options: What to take and how.
        origin: Where the motions come from.
        progress: Told of every frame.

    Returns:
        The report, which also stands in the folder as ``report.json`` and ``report.md``.

    Raises:
        DataError: If the folder is in use, or the source is damaged, not finite, lacks the time
            between frames, or holds no motion. Nothing is left behind then.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DataError(
            f"{folder} already exists and is not empty; nothing is written over it. Choose another "
            f"--out or remove it."
        )
    try:
        with replacing_folder(folder) as temporary:
            state = _Progressing(folder=temporary, options=options, progress=progress)
            return _fill(state, source, origin)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(
            f"interrupted; nothing was left at {folder}, so the import begins anew when it is "
            f"started again."
        ) from None


def _fill(state: _Progressing, source: Iterable[ForeignTrajectory], origin: Origin) -> Report:
    """Write parts, then walls, splits, metadata and report."""
    conversion = state.options.conversion
    open_work_folder(
        state.folder,
        identity={
            "system": "imported",
            "source": origin.source,
            "format": origin.format,
            "conversion": json.loads(json.dumps(asdict(conversion))),
        },
    )
    for foreign in _readable(state, source):
        if state.options.limit is not None and len(state.measure.motions) >= state.options.limit:
            state.complete = False
            break
        _take(state, foreign)
    motions = state.measure.motions
    if not motions:
        why = f" All were dropped, the first: {state.dropped[0]}" if state.dropped else ""
        raise DataError(f"{origin.source} holds no trajectory to import.{why}")
    bounds, said = _walls(motions)
    splits, divided = _splits(motions, state.options.shares)
    left_out = [*(f"Left out: {reason}" for reason in state.dropped), *state.unread]
    complete = state.complete and conversion.stride == 1 and conversion.skip == 0
    notes = (*origin.notes, *conversion.notes(), *said, *divided, *left_out)
    origin = replace(origin, notes=notes, complete=complete and not state.dropped)
    report = make_report(state.measure, origin, bounds=bounds, splits=splits)
    _set_scene(state.folder, motions, bounds, gravity=report.facts["gravity"])
    total = StatisticsAccumulator()
    for index in splits["train"]:
        total.merge(motions[index].statistics)
    extent = float((bounds[:, 1] - bounds[:, 0]).max())
    assemble_dataset(
        state.folder,
        radius=report.suggestion.radius or RADIUS_SHARE * extent,
        splits=splits,
        keep_parts=False,
        statistics=total.statistics(),
    )
    write_json(state.folder / "report.json", report.as_json())
    (state.folder / "report.md").write_text(markdown(report), encoding="utf-8")
    return report


def _readable(
    state: _Progressing, source: Iterable[ForeignTrajectory]
) -> Iterator[ForeignTrajectory]:
    """The trajectories of a source up to where its reader gives up, if that may be left out."""
    try:
        yield from source
    except DataError as error:
        if not (state.options.drop_bad and state.measure.motions):
            raise
        state.unread.append(f"The rest of the source could not be read: {error}")
        state.complete = False


def _take(state: _Progressing, foreign: ForeignTrajectory) -> None:
    """Write and measure one trajectory, or drop it."""
    motions = state.measure.motions
    try:
        motion = converted(foreign, state.options.conversion)
        check_like(motion, motions, frame_dt_needed=True)
        if state.options.frozen_kinematic:
            motion = _with_walls(motion)
        _store(state, motion, part_path(state.folder, len(motions)))
    except DataError as error:
        if not state.options.drop_bad:
            raise
        state.dropped.append(str(error))


def _store(state: _Progressing, motion: ForeignTrajectory, path: Path) -> None:
    """Write one trajectory to its part, measuring it on the way; its walls are set later."""
    gauge = state.measure.begin(motion.name, motion.particle_type, motion.bounds)
    frames = checked_frames(motion, state.measure.motions, finite=True)
    first = next(frames)
    with open_trajectory_writer(
        path,
        particle_type=motion.particle_type,
        frame_dt=motion.frame_dt,
        bounds=np.tile([0.0, 1.0], (first.shape[1], 1)),
        attributes={"source": motion.name},
    ) as writer:
        for frame in _chained(first, frames):
            gauge.add(frame)
            writer.append(frame)
            state.progress(motion.name, 1)
    gauge.finish(
        split=motion.split,
        frame_dt=motion.frame_dt,
        identity_kept=motion.identity_kept,
        notes=motion.notes,
    )


def _with_walls(motion: ForeignTrajectory) -> ForeignTrajectory:
    """The same motion, particles that never move made kinematic where others do move."""
    first, moved = None, np.zeros(len(motion.particle_type), bool)
    for frame in checked_frames(motion, [], finite=True):
        first = frame.copy() if first is None else first
        moved |= (frame != first).any(axis=1)
    frozen = ~moved & (motion.particle_type != KINEMATIC)
    if not frozen.any() or not moved.any():
        return motion
    note = f"{motion.name}: {int(frozen.sum())} particles that never move were made kinematic."
    return replace(
        motion,
        particle_type=np.where(frozen, KINEMATIC, motion.particle_type),
        notes=(*motion.notes, note),
    )


def _chained(first: np.ndarray, rest: Iterator[np.ndarray]) -> Iterator[np.ndarray]:
    yield first
    yield from rest


def _walls(motions: list[MotionSummary]) -> tuple[np.ndarray, list[str]]:
    """The walls of the data set, and what had to be guessed [m]."""
    given = [m.bounds for m in motions if m.bounds is not None]
    if len(given) == len(motions):
        low, high = np.min(given, axis=0)[:, 0], np.max(given, axis=0)[:, 1]
        same = all(np.array_equal(bounds, given[0]) for bounds in given)
        said = [] if same else ["The trajectories have different bounds; those hold all of them."]
        return np.stack([low, high], axis=1), said
    extents = [m.extent for m in motions]
    margin = 0.5 * max(m.spacing for m in motions) or 0.5
    low, high = np.min(extents, axis=0)[:, 0] - margin, np.max(extents, axis=0)[:, 1] + margin
    said = (
        f"The source does not say where its walls are; they were put half a spacing ({margin:.3g} "
        f"m) around all particles. Set them with --bounds."
    )
    return np.stack([low, high], axis=1), [said]


def _splits(
    motions: list[MotionSummary], shares: tuple[float, float] | None
) -> tuple[dict[str, list[int]], list[str]]:
    """Which trajectory belongs to which part, and what was decided here."""
    said = {name: [i for i, m in enumerate(motions) if m.split == name] for name in SPLITS}
    named = [name for name in SPLITS if said[name]]
    valid, test = shares or (0.1, 0.1)
    everything = list(range(len(motions)))
    if shares is not None or not named:
        return split_parts(everything, valid_share=valid, test_share=test), []
    if sum(len(parts) for parts in said.values()) < len(motions) or len(named) == 1:
        what = f"all {named[0]}" if len(named) == 1 else "in part of no named split"
        note = f"What was read is {what}; the trajectories were divided anew (--splits)."
        return split_parts(everything, valid_share=valid, test_share=test), [note]
    if not said["train"] or said["valid"]:
        return said, []
    inner = split_parts(list(range(len(said["train"]))), valid_share=valid, test_share=0.0)
    pool = said["train"]
    for name in ("train", "valid"):
        said[name] = [pool[i] for i in inner[name]]
    note = f"The source has no validation part; {len(said['valid'])} of train were taken for it."
    return said, [note] if said["valid"] else []


def _set_scene(
    folder: Path, motions: list[MotionSummary], bounds: np.ndarray, *, gravity: list[float] | None
) -> None:
    """Write what is known only after the last frame into every part."""
    import h5py

    for index, motion in enumerate(motions):
        attributes: dict[str, Any] = {"source": motion.name}
        if gravity is not None and gravity[1] < 0.0:
            attributes["gravity"] = -gravity[1]
        with h5py.File(part_path(folder, index), "r+") as file:
            file["00000"].attrs["bounds"] = bounds.astype(np.float32)
            file["00000"].attrs["attributes"] = attributes_text(attributes)
