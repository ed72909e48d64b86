"""Progress of a training run: lines or a bar on the terminal, curves in TensorBoard."""

from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchdq.base.optional import imported
from torchdq.base.progress import Progress as Lines

if TYPE_CHECKING:
    from torchdq.learning.training.run import History


class Progress:
    """Display of a run while its `with` block lasts.

    Args:
        last: steps of the whole run.
        step: steps done before, by a run that this one resumes.
        tensorboard: folder of the curves.
        bar: whether to show the bar; None: lines on stderr once the run takes long.
    Raises:
        MissingLibraryError: rich or tensorboard is asked for and not installed.
    """

    def __init__(self, last: int, step: int, tensorboard: str | Path | None, bar: bool | None):
        self._last, self._errors = last, ""
        self._notice = Lines("fitting") if bar is None else None
        self._bar: Any = None
        self._writer: Any = None
        if tensorboard is not None:
            module = imported("torch.utils.tensorboard", "tensorboard", "fit(tensorboard=...)")
            self._writer = module.SummaryWriter(str(tensorboard), purge_step=step + 1)  # drops a killed run's steps
        if bar:
            rich = imported("rich.progress", "rich", "fit(progress=True)")
            columns = (*rich.Progress.get_default_columns(), rich.TextColumn("{task.fields[errors]}"))
            self._bar = rich.Progress(*columns)
            self._task = self._bar.add_task("fit", total=last, completed=step, errors="")
            self._bar.start()

    def __enter__(self) -> "Progress":
        if self._notice is not None:
            self._notice.__enter__()
        return self

    def __exit__(self, *error: Any) -> None:
        if self._notice is not None:
            self._notice.__exit__(*error)
        if self._bar is not None:
            self._bar.stop()
        if self._writer is not None:
            self._writer.close()

    def step(self, step: int) -> None:
        """Show that a step is done."""
        if self._notice is not None:
            self._notice.at(f"step {step} of {self._last}{self._errors}")
        if self._bar is not None:
            self._bar.update(self._task, completed=step)

    def evaluation(self, history: "History", rate: float) -> None:
        """Show the errors of the last evaluation, and the learning rate."""
        errors = {"train": history.train[-1], **({"valid": history.valid[-1]} if history.valid else {})}
        text = "  ".join(f"{name} {error:.3g}" for name, error in errors.items())
        self._errors = f", {text}"
        if self._bar is not None:
            self._bar.update(self._task, errors=text)
        if self._writer is not None:
            for name, value in ({f"error/{k}": v for k, v in errors.items()} | {"rate": rate}).items():
                self._writer.add_scalar(name, value, history.step[-1])
            self._writer.flush()
