"""Processes that begin as a new one that has imported torchdq: forked from it, since importing torch takes seconds.

The process that they are forked from is started with the first of them and ends with the tests. It has imported torchdq
and used nothing of it: no program is recorded, no library is loaded, and the environment has not been read.
"""

import atexit
import multiprocessing
import os
import signal
import subprocess
import traceback
from contextlib import contextmanager
from multiprocessing import forkserver
from pathlib import Path

import torchdq

ROOT = str(Path(torchdq.__file__).parents[1])
CONTEXT = multiprocessing.get_context("forkserver")


class Forked:
    """Process that runs code, and what it writes, in files of a folder."""

    def __init__(self, code: str, environment: dict[str, str], folder: Path):
        self.folder = folder
        self.process = CONTEXT.Process(target=_work, args=(code, environment, folder, torchdq.__file__), daemon=True)
        with _importing():
            self.process.start()

    @property
    def pid(self) -> int:
        """Number of the process, and of its group."""
        return self.process.pid

    @property
    def returncode(self) -> int | None:
        """Exit status, negative for a signal; None while it runs."""
        return self.process.exitcode

    def communicate(self, timeout: float) -> tuple[str, str]:
        """Output and errors, when it has ended."""
        self.process.join(timeout)
        if self.process.is_alive():
            self.kill()
            raise subprocess.TimeoutExpired("forked", timeout, *self.written())
        return self.written()

    def kill(self) -> None:
        """End the process with all that it started."""
        os.killpg(self.pid, signal.SIGKILL)
        self.process.join()

    def written(self) -> tuple[str, str]:
        """Output and errors up to now."""
        return (self.folder / "out").read_text(), (self.folder / "err").read_text()


@contextmanager
def _importing():
    """Environment in which the first process imports this package, on one thread."""
    if forkserver._forkserver._forkserver_pid is not None:
        yield
        return
    forkserver.set_forkserver_preload(["torch", "torchdq"])
    before = dict(os.environ)
    os.environ["OMP_NUM_THREADS"] = "1"
    os.environ["PYTHONPATH"] = os.pathsep.join([ROOT, *filter(None, [before.get("PYTHONPATH")])])
    try:
        yield
    finally:
        os.environ.clear()
        os.environ.update(before)


def _work(code: str, environment: dict[str, str], folder: Path, package: str) -> None:
    """Run code as `python -c` does."""
    os.setsid()
    for stream, name in ((1, "out"), (2, "err")):
        file = os.open(folder / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
        os.dup2(file, stream)
        os.close(file)
    os.environ.clear()
    os.environ.update(environment)
    status = 0
    try:
        assert torchdq.__file__ == package, f"{torchdq.__file__} is not {package}"
        exec(compile(code, "<string>", "exec"), {"__name__": "__main__"})
    except BaseException:
        traceback.print_exc()
        status = 1
    atexit._run_exitfuncs()  # those of a package too, which a process of multiprocessing would leave out
    os._exit(status)
