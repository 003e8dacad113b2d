"""The command line: ``giorom <command>``.

Only the chosen command is imported, so that help is immediate. Exit codes: 0 done, 2 the input was
refused, 3 the work failed, 130 interrupted.
"""

import argparse
import importlib
import os
import sys

COMMANDS = {
    "demo": "one body through the whole method: film, picture, table against MPM",
    "simulate": "make training data with the material point method",
    "import": "make a data set of somebody else's particle motions",
    "inspect": "report on a data set, with pictures",
    "train": "train a time-stepper and a field",
    "rollout": "simulate a body with a trained model, to a file",
    "export": "a motion or a data set for another program: HDF5, GNS, VTKHDF, USD, PLY, film",
    "evaluate": "score a trained model on held-out trajectories",
    "models": "list the pretrained models",
    "benchmark": "speed of the parts: benchmark solver",
    "reproduce": "a table or figure of the paper, ours beside theirs: reproduce table3",
}

FAMILIES = ("benchmark",)
"""Commands whose next word chooses among several."""

MODULES = {"import": "import_data"}
"""Modules of commands whose name Python keeps for itself."""

EXTRAS = {
    "warp": "sim",
    "trimesh": "sim",
    "submitit": "slurm",
    "pyvista": "render",
    "imageio": "render",
    "matplotlib": "render",
    "imageio_ffmpeg": "render",
    "pxr": "usd",
    "neuralop": "baselines",
    "torch_geometric": "baselines",
    "torchdiffeq": "baselines",
    "ot": "baselines",
}
"""Which extra of the package brings a module that is missing."""


MOST_LETTERS = 1200
"""Longest line about a failure; values and names that users give can have any length."""


def main(arguments: list[str] | None = None) -> int:
    """Run one command and return its exit code."""
    arguments = sys.argv[1:] if arguments is None else arguments
    parser = _parser()
    if not arguments or arguments[0] in ("-h", "--help"):
        parser.print_help()
        return 0
    if arguments[0] == "--version":
        from giorom.version import __version__

        print(f"giorom {__version__}")
        return 0
    if arguments[0] not in COMMANDS:
        from giorom.records import nearest

        print(
            f"giorom: there is no command {arguments[0]!r}. {nearest(arguments[0], COMMANDS)}",
            file=sys.stderr,
        )
        return 2
    return _run(arguments[0], arguments[1:])


def _parser() -> argparse.ArgumentParser:
    listing = "\n".join(f"  {name:10s} {text}" for name, text in COMMANDS.items())
    return argparse.ArgumentParser(
        prog="giorom",
        usage="giorom <command> [options]",
        description=f"Learned surrogates of particle physics.\n\ncommands:\n{listing}\n\n"
        f"giorom <command> --help tells more.",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )


def _run(name: str, arguments: list[str]) -> int:
    """Run one command; turn its failures into one line and an exit code."""
    try:
        return _execute(name, arguments)
    except ModuleNotFoundError as error:
        missing = (error.name or "").split(".")[0]
        extra = EXTRAS.get(missing)
        if extra is None:
            raise
        return _refuse(
            name, f"{missing} is not installed; 'pip install \"giorom[{extra}]\"' adds it.", 2
        )
    except ValueError as error:
        return _refuse(name, str(error), 2)
    except KeyboardInterrupt as error:
        line = str(error) or "interrupted; run the same command again (training: with --resume)."
        return _refuse(name, line, 130)
    except BrokenPipeError:
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 0
    except (OSError, RuntimeError, ArithmeticError, MemoryError) as error:
        if os.environ.get("GIOROM_TRACEBACK"):
            raise
        return _refuse(name, f"{type(error).__name__}: {error}", 3)


def _execute(name: str, arguments: list[str]) -> int:
    """Import one command, or the one its next word chooses, and run it."""
    command = importlib.import_module(f"giorom.commands.{MODULES.get(name, name)}")
    description = COMMANDS[name]
    if name in FAMILIES:
        chosen = command.choose(arguments)
        if chosen is None:
            return 0
        name, command, arguments, description = chosen
    from giorom.commands.shared import execute

    return execute(name, command, arguments, description=description)


def _refuse(name: str, text: str, code: int) -> int:
    line = " ".join(text.split())
    line = "".join(letter if letter.isprintable() else ascii(letter)[1:-1] for letter in line)
    if len(line) > MOST_LETTERS:  # the finding stands at the beginning, the remedy at the end
        line = f"{line[: MOST_LETTERS * 2 // 3]} ... {line[-MOST_LETTERS // 3 :]}"
    print(f"giorom {name}: {line}", file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
