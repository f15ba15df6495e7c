"""A Ray cluster: every node takes files, and all of them see the folder of the results.

What goes through Ray is small: the task once, a file's name for each call, and its row back. Poses
are read and written by the nodes themselves. No more calls are under way than twice the cluster's
cores, so that neither the scheduler nor the object store holds a whole data set.
"""

import functools
import os
import pickle
import sys
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from spt_jax.datasets.engines.events import Finished, Progress, StartError
from spt_jax.datasets.items.inventory import Item
from spt_jax.datasets.items.store import Store
from spt_jax.datasets.items.work import RoomError, Task, lost, work


class Resources(NamedTuple):
    """What a call asks of the cluster.

    Attributes:
        address: the cluster's; None for the one that RAY_ADDRESS names, that this machine runs, or
            a new one.
        cpus: cores of a call.
        memory: bytes that a call reserves; None reserves none.
        retries: how often a call is repeated whose process or node has ended.
    """

    address: str | None = None
    cpus: float = 1.0
    memory: int | None = None
    retries: int = 3


def cluster(
    store: Store, task: Task, items: Sequence[Item], resources: Resources
) -> Iterator[Finished | Progress]:
    """Work on files with a Ray cluster.

    Raises:
        RoomError: the folder of the results takes no more.
        StartError: Ray is not installed or cannot be reached; a node does not see the folder.
    """
    ray = _ray()
    own = not ray.is_initialized()
    if own:
        try:
            ray.init(address=resources.address, log_to_driver=False, logging_level="error")
        except (ConnectionError, RuntimeError, ValueError) as error:
            raise StartError(
                f"address must lead to a Ray cluster: got {resources.address!r} ({error})"
            ) from error
    pending: dict[Any, Item] = {}
    try:
        yield from _calls(ray, store, task, items, resources, pending)
    finally:
        for call in pending:
            ray.cancel(call, force=True)
        if own:
            ray.shutdown()


def _ray() -> Any:
    try:
        import ray
    except ImportError as error:
        raise StartError(
            'engine must be one that is installed: got "ray" without Ray; pip install '
            '"spt-jax[cluster]", or take the engine "local"'
        ) from error
    return ray


def _calls(
    ray: Any,
    store: Store,
    task: Task,
    items: Sequence[Item],
    resources: Resources,
    pending: dict[Any, Item],
) -> Iterator[Finished]:
    remote = ray.remote(_work).options(
        num_cpus=resources.cpus,
        memory=resources.memory,
        max_retries=resources.retries,
        retry_exceptions=False,  # what a file does to us it does again
    )
    paths = [os.path.abspath(path) for path in sys.path]
    prepared = ray.put(pickle.dumps((Store(store.out.resolve()), paths, pickle.dumps(task))))
    left = list(reversed(items))
    while left or pending:
        cores = ray.cluster_resources().get("CPU", 1.0)
        while left and len(pending) < max(2.0 * cores / max(resources.cpus, 0.01), 2.0):
            item = left.pop()
            absolute = item._replace(path=item.path.absolute())
            pending[remote.remote(prepared, absolute)] = item
        for call in ray.wait(list(pending), num_returns=1, timeout=1.0)[0]:
            item = pending.pop(call)
            yield Finished(item, _row(ray, call, store, item, resources.retries))


def _row(ray: Any, call: Any, store: Store, item: Item, retries: int) -> dict[str, Any] | None:
    """The row that a call returned, or that of a file at which calls ended again and again."""
    try:
        kind, answer = ray.get(call)
    except (ray.exceptions.RayError, ray.exceptions.TaskUnschedulableError) as error:
        words = " ".join(str(error).split())[:300]
        return lost(store, item, f"{retries + 1} calls ended while they worked on it: {words}")
    if kind == "start":
        raise StartError(answer)
    if kind == "full":
        raise RoomError(None, answer)
    return answer


def _work(prepared: bytes, item: Item) -> tuple[str, Any]:
    """On a node: the row of a file, or what stands against it."""
    try:
        store, task = _started(prepared)
    except Exception as error:
        return "start", f"{type(error).__name__}: {' '.join(str(error).split())}"
    try:
        return "row", work(store, task, item, lambda *_: None)
    except RoomError as error:
        return "full", str(error.strerror)


@functools.lru_cache(maxsize=4)
def _started(prepared: bytes) -> tuple[Store, Task]:
    """The store and the task, which has started: once in each process."""
    store, paths, packed = pickle.loads(prepared)
    sys.path += [path for path in paths if path not in sys.path]  # where the task's module may be
    task = pickle.loads(packed)
    if not (store.folder / "settings.json").exists():
        raise OSError(
            f"out must be a folder that every node of the cluster sees: got {str(store.out)!r}, "
            f"which {os.uname().nodename} does not; take one on a shared file system"
        )
    task.start()
    return store, task
