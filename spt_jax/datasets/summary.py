"""What came of a data set: the rows as JSON Lines and CSV, their sums, and the report."""

import csv
import io
import json
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from spt_jax.datasets.items.inventory import Inventory
from spt_jax.datasets.items.store import Store
from spt_jax.datasets.items.work import Task
from spt_jax.files.outputs import atomic_write, write_json

# Of these, neither sum nor mean says anything.
_NOT_SUMMED = {"input_modified_ns", "frame_rate", "worst_frame"}

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Summary:
    """What came of a data set.

    Attributes:
        task: what was done, such as "clean".
        files: how many files it has.
        by_status: how many of them ended how: "done", "failed" (damaged, or a fault), "unknown"
            (none of the kind), "lost" (processes ended at it).
        missing: how many have not been worked on: other shards', or what an ended run left.
        kept: how many of this run's files were done before it.
        others: by suffix, how many files there are that are none of the data set.
        seconds: how long this run took.
        figures: sums, means and maxima over all rows.
        failures: names and messages of the files that are not "done", the first thousand.
    """

    task: str
    files: int
    by_status: dict[str, int]
    missing: int
    kept: int
    others: dict[str, int]
    seconds: float
    figures: dict[str, float]
    failures: list[dict[str, str]]

    @property
    def is_whole(self) -> bool:
        """Whether every file is done, or is none of the kind."""
        return not self.missing and set(self.by_status) <= {"done", "unknown"}

    def as_dict(self) -> dict[str, Any]:
        """All of it as JSON types."""
        return asdict(self)


def write_results(
    store: Store,
    task: Task,
    found: Inventory,
    seconds: float,
    kept: int,
    *,
    draw: bool = True,
) -> Summary:
    """Write the rows, the summary and the report; the summary.

    Args:
        store, task, found: the data set.
        seconds, kept: of this run.
        draw: whether pictures that are missing are drawn.

    Raises:
        OSError: there is no room.
    """
    drawing: Callable[..., str] | None = getattr(task, "draw", None)
    why_not = "the run was ended"
    if drawing is not None and draw:  # which takes seconds, before others are kept waiting
        why_not = drawing(store, found, _rows(store, found))
    store.sweep()
    with store.writing() as within:
        rows = _rows(store, found)
        summary = summarized(task.name, found, rows, seconds, kept)
        lines = "".join(f"{json.dumps(row)}\n" for row in rows)
        _write(store.out / "manifest.jsonl", lines, within)
        _write(store.out / "manifest.csv", as_csv(rows), within)
        people = [
            {"name": row["name"], **person} for row in rows for person in row.get("people", ())
        ]
        if people:
            _write(store.out / "people.csv", as_csv(people), within)
        write_json(store.out / "summary.json", summary.as_dict(), within=within)
        if drawing is not None:
            from spt_jax.datasets.report import page

            _write(store.out / "report.html", page(store, rows, summary, why_not), within)
    return summary


def _rows(store: Store, found: Inventory) -> list[dict[str, Any]]:
    return [row for item in found.items if (row := store.row(item.name)) is not None]


def _write(path: Path, text: str, within: Path) -> None:
    with atomic_write(path, within=within) as temporary:
        temporary.write_text(text, encoding="utf-8", newline="")


def summarized(
    task: str, found: Inventory, rows: Sequence[Row], seconds: float, kept: int
) -> Summary:
    """The summary of rows."""
    return Summary(
        task=task,
        files=len(found.items),
        by_status=dict(sorted(Counter(row["status"] for row in rows).items())),
        missing=len(found.items) - len(rows),
        kept=kept,
        others=found.others,
        seconds=round(seconds, 3),
        figures=figures_of(rows),
        failures=[
            {key: row[key] for key in ("name", "status", "message")}
            for row in rows
            if row["status"] != "done"
        ][:1000],
    )


def figures_of(rows: Iterable[Row]) -> dict[str, float]:
    """Maxima of what is called largest, means over frames of means, sums of all other numbers."""
    columns: dict[str, list[tuple[float, float]]] = {}
    for row in rows:
        for key, value in row.items():
            if isinstance(value, int | float) and key not in _NOT_SUMMED:
                columns.setdefault(key, []).append((float(value), float(row.get("frames", 1))))
    return {key: _together(key, values) for key, values in columns.items()}


def _together(key: str, values: Sequence[tuple[float, float]]) -> float:
    if key.startswith("largest_"):
        return max(value for value, _ in values)
    if key.startswith("mean_"):
        frames = sum(weight for _, weight in values)
        return sum(value * weight for value, weight in values) / frames if frames else 0.0
    return sum(value for value, _ in values)


def as_csv(rows: Sequence[Row]) -> str:
    """Rows as CSV; lists of words and numbers are joined by semicolons, all else is left out.

    Example:
        >>> print(as_csv([{"name": "a", "outputs": ["a.npz"]}, {"name": "b", "frames": 3}]), end="")
        name,outputs,frames
        a,a.npz,
        b,,3
    """
    columns = dict.fromkeys(
        key for row in rows for key, value in row.items() if _cell(value) is not None
    )
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(columns)
    writer.writerows([_cell(row.get(key, "")) for key in columns] for row in rows)
    return text.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, list):
        plain = all(isinstance(entry, str | int | float) for entry in value)
        return ";".join(map(str, value)) if plain else None
    return None if isinstance(value, Mapping) else value
