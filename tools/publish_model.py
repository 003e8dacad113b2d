"""Put a trained simulator into the package, with its card and its line in the index.

    python tools/publish_model.py NAME RUN --train train.json --evaluate metrics.json \
        --data data --command "giorom simulate ..." --command "giorom train ..."

The numbers of the card are those of the JSON files that ``giorom train --json`` and
``giorom evaluate --json`` wrote; nothing is typed by hand.
"""

import argparse
import json
import platform
import shutil
import sys
from pathlib import Path

from giorom.data.atomic import replacing_folder
from giorom.data.metadata import read_metadata
from giorom.evaluation.card import model_card
from giorom.evaluation.catalogue import update_catalogue
from giorom.simulator import PRETRAINED, Simulator, pretrained_directory

SIZE_LIMIT = 5_000_000
"""Largest model file of the package [bytes]."""


def main() -> int:
    """Copy, check, write card and index."""
    arguments = _parse()
    simulator = Simulator.from_pretrained(arguments.run)
    trained = json.loads(arguments.train.read_text())
    scores = json.loads(arguments.evaluate.read_text())
    target = PRETRAINED / arguments.name
    size = (pretrained_directory(arguments.run) / "model.safetensors").stat().st_size
    if size > SIZE_LIMIT:
        sys.stderr.write(
            f"{arguments.run} has {size} bytes of weights; a model of the package may have "
            f"{SIZE_LIMIT}. Train a smaller network.\n"
        )
        return 2
    with replacing_folder(target) as directory:
        simulator.save_pretrained(directory)
        card = model_card(
            arguments.name, simulator.config, trained, scores, commands=arguments.command
        )
        (directory / "README.md").write_text(card)
        shutil.copy(arguments.evaluate, directory / "metrics.json")
        record = trained | _machine() | {"data_seed": read_metadata(arguments.data).get("seed")}
        (directory / "training.json").write_text(json.dumps(record, indent=1) + "\n")
    update_catalogue(PRETRAINED, arguments.name, arguments.command)
    return 0


def _parse() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("name")
    parser.add_argument("run", type=Path)
    parser.add_argument("--train", type=Path, required=True)
    parser.add_argument("--evaluate", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True, help="the training data")
    parser.add_argument("--command", action="append", default=[])
    return parser.parse_args()


def _machine() -> dict[str, str]:
    """What the numbers were made on."""
    return {"python": platform.python_version(), "processor": platform.machine()}


if __name__ == "__main__":
    sys.exit(main())
