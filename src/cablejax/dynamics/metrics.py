"""Training metrics to a CSV file and to TensorBoard, consistent after a resume."""

from __future__ import annotations

import csv
from pathlib import Path

from tensorboardX import SummaryWriter

from cablejax.dynamics.run_folder import BOARD, METRICS


class MetricsLog:
    """Appends rows of numbers, keyed by optimiser step.

    Rows after `resume_step` stem from work that was lost with the process and is about to be repeated: they are
    dropped, as are rows that a full disk cut short.
    """

    def __init__(self, folder: Path, columns: tuple[str, ...], resume_step: int):
        self._columns = columns
        path = folder / METRICS
        kept: list[list[str]] = []
        if path.exists():
            with path.open(newline="") as file:
                rows = list(csv.reader(file))
            whole = [row for row in rows[1:] if len(row) == len(columns) + 1 and row[0].isdecimal()]
            kept = [row for row in whole if int(row[0]) <= resume_step]
        self._file = path.open("w", newline="")
        self._csv = csv.writer(self._file)
        self._csv.writerow(["step", *columns])
        self._csv.writerows(kept)
        self._file.flush()
        self._board = SummaryWriter(str(folder / BOARD), purge_step=resume_step + 1, write_to_disk=True)

    def __enter__(self) -> MetricsLog:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()
        self._board.close()

    def write(self, step: int, values: dict[str, float]) -> None:
        """One row; columns without a value stay empty."""
        self._csv.writerow([step, *(f"{values[c]:.6g}" if c in values else "" for c in self._columns)])
        self._file.flush()
        for name, value in values.items():
            self._board.add_scalar(name, value, step)
