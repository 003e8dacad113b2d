"""Checkpoints: one directory each, complete or absent, without pickle.

A checkpoint is written under a temporary name and renamed, so that a reader never sees half of
one. It holds every number training needs to go on: weights, averaged weights, optimiser moments,
random state and counters.
"""

import json
import shutil
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

from giorom.data.atomic import replacing_folder
from giorom.records import one_line

CHECKPOINT_PREFIX = "step-"


class CheckpointError(ValueError):
    """A checkpoint cannot be used; the message says why."""


def unfit_checkpoint(folder: Path, error: Exception) -> CheckpointError:
    """The error of a run whose checkpoint is damaged or of another model.

    Args:
        folder: Directory of the run.
        error: What loading it raised.
    """
    return CheckpointError(
        f"the checkpoint in {folder} does not fit this training ({one_line(error)[:200]}). Train "
        f"into another folder."
    )


def save_checkpoint(
    folder: Path,
    *,
    step: int,
    tensors: dict[str, Tensor],
    record: dict[str, Any],
) -> Path:
    """Write checkpoint ``step`` below ``folder`` and drop the ones before it.

    Args:
        folder: Directory of the checkpoints of a run.
        step: Optimiser steps done.
        tensors: Named tensors.
        record: JSON values.

    Returns:
        The new directory.
    """
    path = folder / f"{CHECKPOINT_PREFIX}{step:09d}"
    copies = {name: tensor.detach().cpu().clone() for name, tensor in tensors.items()}
    with replacing_folder(path) as directory:
        save_file(copies, directory / "state.safetensors")
        (directory / "state.json").write_text(json.dumps({"step": step, **record}))
    for older in folder.glob(f"{CHECKPOINT_PREFIX}*"):
        if older.name < path.name:
            shutil.rmtree(older)
    return path


def load_checkpoint(folder: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read the newest checkpoint below ``folder``.

    Raises:
        CheckpointError: If there is none or it is damaged.
    """
    found = sorted(folder.glob(f"{CHECKPOINT_PREFIX}*"))
    if not found:
        raise CheckpointError(
            f"{folder} holds no checkpoint to resume from; train into another folder without "
            f"--resume."
        )
    try:
        tensors = load_file(found[-1] / "state.safetensors")
        record = json.loads((found[-1] / "state.json").read_text())
    except (OSError, ValueError, SafetensorError) as error:
        raise CheckpointError(
            f"checkpoint {found[-1]} is damaged ({error}). Earlier ones are not kept; train "
            f"into another folder without --resume."
        ) from None
    return tensors, record


def optimizer_tensors(optimizer: torch.optim.Optimizer, names: list[str]) -> dict[str, Tensor]:
    """Moments of the optimiser as named tensors: ``optimizer.<moment>.<parameter>``."""
    states = optimizer.state_dict()["state"]
    return {
        f"optimizer.{moment}.{names[index]}": torch.as_tensor(value)
        for index, moments in states.items()
        for moment, value in moments.items()
    }


def load_optimizer_tensors(
    optimizer: torch.optim.Optimizer, names: list[str], tensors: dict[str, Tensor]
) -> None:
    """Inverse of ``optimizer_tensors``; hyper-parameters stay those of ``optimizer``."""
    states: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        if key.startswith("optimizer."):
            _, moment, name = key.split(".", 2)
            states.setdefault(names.index(name), {})[moment] = value
    groups = optimizer.state_dict()["param_groups"]
    optimizer.load_state_dict({"state": states, "param_groups": groups})
