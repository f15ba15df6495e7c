"""A task over a folder, from the inventory to the summary; what is done is not done again."""

import os
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from pathlib import Path
from typing import Any, Literal

from spt_jax.datasets.engines.cluster import Resources, cluster
from spt_jax.datasets.engines.events import Finished, Progress
from spt_jax.datasets.engines.local import local
from spt_jax.datasets.items.inventory import Item, as_shard, take_inventory
from spt_jax.datasets.items.store import Store
from spt_jax.datasets.items.work import Task, is_whole, usable_cores
from spt_jax.datasets.summary import Summary, write_results

Engine = Literal["local", "ray"]
OnEvent = Callable[[Finished | Progress], None]

# What a process takes that cleans motions, with room for the largest.
_MEMORY_A_PROCESS = 1.2e9

# How long is waited before files of another run are looked at again, in seconds.
_PATIENCE = 0.5


def run(
    task: Task,
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    engine: Engine = "local",
    processes: int | Literal["auto"] = "auto",
    shard: str | tuple[int, int] | None = None,
    anew: bool = False,
    retry: bool = False,
    verify: bool = False,
    ray: Resources | None = None,
    on_event: OnEvent | None = None,
) -> Summary:
    """Have a task done with every file of a folder, and results that are whole, once each.

    Whatever ends a run, the same call goes on with what is not done. Several may work on one folder
    at a time, on one machine or on many that share it: none does what another is at. A file that
    cannot be read has a row that says why, and the run goes on.

    Args:
        task: what is done with each file.
        folder: the data set; folders in it are looked through too.
        out: where results go, made where missing. Nothing is written elsewhere.
        engine: "local", processes of this machine, or "ray", a Ray cluster (extra `cluster`).
        processes: of the engine "local": how many; "auto" for one a core, as far as there is memory
            for; 0 works in this one.
        shard: work on one of n parts of the files alone, "i/n" with i from 0: for job arrays.
        anew: do what is done again, whatever the settings were.
        retry: try files again that failed.
        verify: compare what is done with its hashes, rather than its sizes.
        ray: what the engine "ray" asks of the cluster, a `Resources`; by default a core a file.
        on_event: called with a `Finished` for each file, and with `Progress` on the way.

    Returns:
        The summary of all that is done in `out`, other shards included, as `summary.json` has it.

    Raises:
        FileNotFoundError, NotADirectoryError: there is no such folder.
        OSError: `out` cannot be written, or is full. What is done stays.
        ValueError: `out` is the folder or holds it, or results of other settings; a shard, engine
            or number of processes that is none; a task of the script that runs, which other
            processes cannot import.
        RuntimeError: a process or the cluster cannot start.

    Example:
        >>> import pathlib, tempfile
        >>> from spt_jax.datasets import run
        >>> class Count:
        ...     name = "count"
        ...     def settings(self): return {}
        ...     def wants(self, path): return path.suffix == ".txt"
        ...     def start(self): pass
        ...     def work(self, path, out, report): return {"letters": len(path.read_text())}
        >>> with tempfile.TemporaryDirectory() as top:
        ...     folder = pathlib.Path(top, "texts")
        ...     folder.mkdir()
        ...     _ = (folder / "a.txt").write_text("three")
        ...     found = run(Count(), folder, pathlib.Path(top, "out"), processes=0)
        >>> found.files, found.by_status
        (1, {'done': 1})
    """
    source, target = _as_folders(folder, out)
    part, count = as_shard(shard), _as_processes(processes)
    if engine not in ("local", "ray"):
        raise ValueError(f'engine must be "local" or "ray": got {engine!r}.')
    if type(task).__module__ == "__main__" and (count or engine == "ray"):
        raise ValueError(
            f"task must be of a class that other processes can import: got {type(task).__name__}, "
            "of the script that runs; move it into a module, or work with processes=0."
        )
    report = on_event or (lambda event: None)
    begin = time.perf_counter()
    together = getattr(task, "are_one", None)
    found = take_inventory(source, target, task.wants, together or (lambda paths: False))
    store = Store(target)
    store.begin({"task": task.name, **task.settings()}, anew=anew)
    mine = [item for item in found.items if part.has(item.name)]
    left = _left(store, mine, retry, verify)
    kept = len(mine) - len(left)
    report(Progress("", kept, len(mine), "files"))
    try:
        # The longest first: the last ones to be done then keep nobody waiting for long.
        left.sort(key=lambda item: (-item.size, item.name))
        while left:
            events = (
                cluster(store, task, left, ray or Resources())
                if engine == "ray"
                else local(store, task, left, count)
            )
            busy: list[Item] = []
            with closing(events):  # pyright: ignore[reportArgumentType]
                for event in events:
                    if isinstance(event, Finished) and event.row is None:
                        busy.append(event.item)
                    else:
                        report(event)
            left = _left_by_others(store, busy, report)
    except BaseException:
        # What is done is reported, at least where there is space for it.
        with suppress(OSError):
            write_results(store, task, found, time.perf_counter() - begin, kept, draw=False)
        raise
    return write_results(store, task, found, time.perf_counter() - begin, kept)


def _left(store: Store, items: Sequence[Item], retry: bool, verify: bool) -> list[Item]:
    """The files that are not done."""
    left = []
    for item in items:
        row = store.row(item.name)
        if row is not None and retry and row["status"] == "failed":
            with store.claim(item.name) as taken:
                if taken:
                    store.discard(item.name)
            row = None
        if row is None or not is_whole(store, row, item):
            left.append(item)
        elif verify and not store.verified(row):
            store.discard(item.name)
            left.append(item)
    return left


def _left_by_others(store: Store, items: Sequence[Item], report: OnEvent) -> list[Item]:
    """Wait for files that other runs are at; the ones that these have left undone."""
    free, still = [], list(items)
    while still:
        waiting = []
        for item in still:
            row = store.row(item.name)
            if row is not None and is_whole(store, row, item):
                report(Finished(item, row))
                continue
            with store.claim(item.name) as taken:
                (free if taken else waiting).append(item)
        still = waiting
        if still:
            report(Progress(still[0].name, 0, 1, "another run works on it"))
            time.sleep(_PATIENCE)
    return free


def _as_folders(folder: Any, out: Any) -> tuple[Path, Path]:
    source, target = Path(folder), Path(out)
    if not source.exists():
        raise FileNotFoundError(f"folder must exist: got {str(source)!r}; check the spelling.")
    if not source.is_dir():
        raise NotADirectoryError(
            f"folder must be a folder: got the file {str(source)!r}; a single file is "
            "`spt-jax untangle`'s."
        )
    inner, outer = source.resolve(), target.resolve()
    if inner == outer or outer in inner.parents:
        raise ValueError(
            f"out must not be the folder of the data set, nor hold it: got {str(target)!r} for "
            f"{str(source)!r}; choose another, which may lie in it."
        )
    return source, target


def _as_processes(processes: Any) -> int:
    if processes == "auto":
        return int(max(1, min(usable_cores(), _memory() // _MEMORY_A_PROCESS)))
    if isinstance(processes, bool) or not isinstance(processes, int) or processes < 0:
        raise ValueError(
            f'processes must be "auto" or a whole number, not negative: got {processes!r}.'
        )
    return processes


def _memory() -> float:
    """Bytes of memory that are free; without end where the system does not say."""
    try:
        with open("/proc/meminfo", encoding="ascii") as stream:
            for line in stream:
                if line.startswith("MemAvailable:"):
                    return 1024.0 * int(line.split()[1])
    except (OSError, ValueError):
        pass
    return float("inf")
