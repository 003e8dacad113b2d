"""Call a function in a process that has done nothing before: for times and memory of its own."""

import multiprocessing
import os
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection, wait
from typing import Any


def call_afresh(function: Callable[[Any], Any], argument: Any) -> Any:
    """``function(argument)``, computed in a new process.

    Args:
        function: Function of a module.
        argument: What it gets; has to survive a pipe, as has its result.

    Raises:
        RuntimeError: If the function raises, or the process is ended from outside.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(theirs, function, argument), daemon=True)
    process.start()
    theirs.close()
    try:
        failure, result = ours.recv()
    except EOFError:
        process.join()
        raise RuntimeError(
            f"a process that measured {function.__name__} was ended (code {process.exitcode}): "
            f"killed, or out of memory. Run the same command again; what is finished is kept."
        ) from None
    finally:
        process.terminate()
        process.join()
        ours.close()
    if failure is not None:
        raise RuntimeError(f"{function.__name__} failed in a process of its own: {failure}")
    return result


def _serve(connection: Connection, function: Callable[[Any], Any], argument: Any) -> None:
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        answer = (None, function(argument))
    except Exception as error:
        answer = (f"{type(error).__name__}: {error}", None)
    connection.send(answer)


def _end_with_parent() -> None:
    """End this process when its parent is gone, even by SIGKILL."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
