"""Ctrl-C while the command line is loaded, which takes seconds: the process ends at once, without a traceback.

The package imports this first of all, since its other imports are what takes the time. `torchdq.command.main` gives
Ctrl-C back to Python.
"""

import signal
import sys
import threading
from pathlib import Path


def _is_command() -> bool:
    """Whether the process is `torchdq`, or `python -m torchdq`, whose first argument is -m until it is found."""
    if sys.argv[:1] == ["-m"]:
        return sys.orig_argv[sys.orig_argv.index("-m") + 1 :][:1] == ["torchdq"] if "-m" in sys.orig_argv else False
    return bool(sys.argv) and Path(sys.argv[0]).stem == "torchdq"


def _is_free() -> bool:
    """Whether Ctrl-C still has the handler of Python, and this thread may change it."""
    main = threading.current_thread() is threading.main_thread()
    return main and signal.getsignal(signal.SIGINT) is signal.default_int_handler


def restore() -> None:
    """Give Ctrl-C back to Python, which raises KeyboardInterrupt, if loading has taken it."""
    if LOADED_AS_COMMAND:
        signal.signal(signal.SIGINT, signal.default_int_handler)


LOADED_AS_COMMAND = _is_command() and _is_free()
if LOADED_AS_COMMAND:
    signal.signal(signal.SIGINT, signal.SIG_DFL)  # a shell sees exit code 130
