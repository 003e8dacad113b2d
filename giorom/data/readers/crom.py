"""Read CROM, LiCROM and FEM sequences: folders ``sim_seq_*`` of ``h5_f_0000000000.h5`` files.

Each file holds the reference positions ``x`` and the state ``q``, both of shape (3, N). In
LiCROM ``q`` is the displacement, elsewhere it is the current position; the first frame tells which:
there the body is near its reference, so that either ``q`` or ``q - x`` is small.
"""

import re
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from giorom.data.readers.cloud import Cloud, check_count, cloud_of
from giorom.data.readers.frame_files import FileSeries, series_of
from giorom.data.readers.hdf5_guard import guarded_file, member, numbers_of, rows_of
from giorom.data.readers.sequence import sequence_trajectory
from giorom.data.readers.source import DataError, ForeignTrajectory, Reader

__all__ = ["CROM"]

FRAME_NAME = re.compile(r"h5_f_\d+\.h5")

CLEAR_RATIO = 0.3
"""Above this ratio of the smaller to the larger candidate the guess is called unsure."""

REST_TOLERANCE = 1e-5
"""Change of the reference positions that is still rounding, as a share of the body's length."""


def _series(path: Path) -> Iterator[FileSeries]:
    """The sequences below a path."""
    for series in series_of(path, (".h5",)):
        if FRAME_NAME.fullmatch(series.files[0].name):
            folder = series.files[0].parent.name
            yield FileSeries(
                name=folder if len(series.files) > 1 else series.name,
                files=series.files,
                split=series.split,
                notes=series.notes,
            )


def _detect(path: Path) -> bool:
    """Whether the first frame below a path holds x and q."""
    try:
        for series in _series(path):
            with guarded_file(series.files[0]) as file:
                return "x" in file.keys() and "q" in file.keys()
    except (OSError, DataError):
        return False
    return False


def _read(path: Path) -> Iterator[ForeignTrajectory]:
    """Each sequence as a motion."""
    found = False
    for series in _series(path):
        found = True
        yield _read_sequence(series)
    if not found:
        raise DataError(
            f"{path} holds no files h5_f_*.h5, itself or in folders sim_seq_*. Check the path."
        )


def _read_sequence(series: FileSeries) -> ForeignTrajectory:
    """One sequence, after telling from its first frame what q is."""
    reference, state, _ = _arrays(series.files[0])
    if reference.shape != state.shape:
        raise _different_shapes(series.files[0], reference, state)
    with np.errstate(all="ignore"):
        size = float(np.ptp(reference, axis=0).max())
        as_displacement = _mean_size(state)
        as_position = _mean_size(state - reference)
    displaced = as_displacement <= as_position
    small, large = sorted((as_displacement, as_position))
    kind = "the displacement (position = x + q)" if displaced else "the current position"
    doubt = "" if small <= CLEAR_RATIO * large else " Neither is small, so look at the result."
    note = (
        f"q is taken for {kind}: in the first frame the mean of |q| is {as_displacement:.3g} and "
        f"that of |q - x| is {as_position:.3g}.{doubt}"
    )
    noted = FileSeries(
        name=series.name,
        files=series.files,
        split=series.split,
        notes=(*series.notes, note),
    )
    read_frame = partial(_read_frame, reference=reference, size=size, displaced=displaced)
    return sequence_trajectory(noted, read_frame, identity_kept=True)


def _read_frame(path: Path, *, reference: np.ndarray, size: float, displaced: bool) -> Cloud:
    """The points of one file, whose reference positions must be the first file's."""
    rest, state, time = _arrays(path)
    if rest.shape != state.shape:
        raise _different_shapes(path, rest, state)
    with np.errstate(all="ignore"):
        same = rest.shape != reference.shape or np.allclose(
            rest, reference, rtol=0.0, atol=REST_TOLERANCE * size, equal_nan=True
        )
        position = rest + state if displaced else state
    if not same:
        raise DataError(
            f"{path} has other reference positions x than the first frame of its sequence, so that "
            f"its points are others or in another order. Write the same x in every frame."
        )
    return cloud_of(position, {}, path=path, time=time)


def _mean_size(values: np.ndarray) -> float:
    """Mean of the sizes of the finite numbers; 0 if there are none."""
    size = np.abs(values[np.isfinite(values)])
    return float(size.mean()) if len(size) else 0.0


def _different_shapes(path: Path, rest: np.ndarray, state: np.ndarray) -> DataError:
    """Error of a file whose two arrays do not fit together."""
    return DataError(
        f"{path} has x for {len(rest)} points and q for {len(state)}; both must have the shape "
        f"(3, N). Remake the file."
    )


def _arrays(path: Path) -> tuple[np.ndarray, np.ndarray, float | None]:
    """Reference positions and state, one point per row, and the time if it is there."""
    with guarded_file(path) as file:
        arrays = []
        for name in ("x", "q"):
            data = numbers_of(file, name, path=path, dims=2)
            if data is None:
                raise DataError(f"{path} has no '{name}'. It is no file of CROM; check the path.")
            if data.shape[0] not in (2, 3) and data.shape[1] not in (2, 3):
                raise DataError(
                    f"{path}: '{name}' has the shape {data.shape}; it must be (3, N), one column "
                    f"per point. Reduced states are not positions: decode them first."
                )
            values = rows_of(data, 0, len(data), path=path)
            arrays.append(values.T if len(values) in (2, 3) else values)
            check_count(len(arrays[-1]), path.stat().st_size, 0, path=path)
        floating = [values.astype(np.result_type(values, np.float32)) for values in arrays]
        return floating[0], floating[1], _time(file, path)


def _time(file: Any, path: Path) -> float | None:
    """The time of a file, if it holds a single number of that name."""
    data = file.get("time") if member(file, "time", path=path) is not None else None
    shape = getattr(data, "shape", None)
    if not shape or data.size != 1 or len(shape) > 2:
        return None
    time = numbers_of(file, "time", path=path, dims=len(shape))
    return float(rows_of(time, 0, 1, path=path).reshape(-1)[0])


CROM = Reader(
    name="crom",
    title="CROM / LiCROM / FEM folders sim_seq_*/h5_f_*.h5",
    detect=_detect,
    read=_read,
)
"""Reader of CROM's sequences."""
