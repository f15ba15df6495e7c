"""One law of pools of processes, tried on one candidate: `python -m benchmarks.pool_laws LAW NAME`.

Each law has a process of its own, as each user has: it imports JAX, starts a pool, and prints what
it found as JSON. `benchmarks.pools` runs all of them.
"""

import atexit
import contextlib
import json
import os
import signal
import statistics
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np

from benchmarks.pool_candidates import CANDIDATES, Candidate
from spt_jax import load_body, load_mocap
from spt_jax._query import as_directions
from spt_jax.bridge.worker import Mesh
from spt_jax.overlap.exclusions import NOTHING
from spt_jax.overlap.host_functions import PenaltyOptions, value_and_gradient_on_host
from spt_jax.overlap.measure import Sampling

OPTIONS = PenaltyOptions(
    "volume", "boundary", "vertex", Sampling(None, as_directions(3)), NOTHING, 1.2e-7
)


class Finding(NamedTuple):
    """Whether a law holds, and the figure by which that is decided."""

    met: bool
    figure: str


def bodies(count: int = 16) -> list[Mesh]:
    """Posed bodies that share their faces."""
    body, mocap = load_body(), load_mocap()
    frames = np.linspace(0, len(mocap.names) - 1, count).astype(int)
    vertices = np.asarray(body(body.pose_from_smpl(mocap.pose[frames])).vertices, np.float64)
    faces = np.asarray(body.faces, np.int64)
    return [(one, faces) for one in vertices]


def here(meshes: list[Mesh]) -> list:
    return [value_and_gradient_on_host(*mesh, OPTIONS) for mesh in meshes]


def is_same(found: list, expected: list) -> bool:
    pairs = zip(found, expected, strict=True)
    return all(
        np.array_equal(a, b) for one, other in pairs for a, b in zip(one, other, strict=True)
    )


def run(pool: Candidate, meshes: list[Mesh]) -> list:
    return pool.measure(value_and_gradient_on_host, OPTIONS, meshes)


def seconds(call: Callable[[], object]) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def until_ready(pool: Candidate, meshes: list[Mesh]) -> int:
    """Ask until the worker has answered: its number."""
    before = pool.answered
    for _ in range(600):
        run(pool, meshes[:4])
        if pool.answered > before:
            for _ in range(3):  # and what is usual has been learned
                run(pool, meshes)
            return pool.pid()
        time.sleep(0.1)
    raise TimeoutError("the worker never answered.")


def same_bits(pool: Candidate) -> Finding:
    meshes = bodies()
    until_ready(pool, meshes)
    return Finding(is_same(run(pool, meshes), here(meshes)), f"{pool.answered} answers")


def killed(pool: Candidate) -> Finding:
    meshes = bodies()
    pid = until_ready(pool, meshes)
    alone = seconds(lambda: here(meshes))
    threading.Timer(0.3 * alone / 2, os.kill, (pid, signal.SIGKILL)).start()
    begin = time.perf_counter()
    same = is_same(run(pool, meshes), here(meshes))
    took = time.perf_counter() - begin - alone
    again = until_ready(pool, meshes) != pid
    return Finding(same and again and took < 3 * alone + 1, f"{took / alone:.1f} times alone")


def stopped(pool: Candidate) -> Finding:
    meshes = bodies()
    pid = until_ready(pool, meshes)
    alone = seconds(lambda: here(meshes))
    os.kill(pid, signal.SIGSTOP)
    found: list = []
    took = [seconds(lambda: found.append(run(pool, meshes))) for _ in range(3)]
    same = all(is_same(one, here(meshes)) for one in found)
    os.kill(pid, signal.SIGCONT)
    back = until_ready(pool, meshes) == pid
    worst = max(took) / alone
    return Finding(same and back and worst < 4, f"{worst:.1f} times alone at worst")


def leaves_with_stopped(pool: Candidate) -> Finding:
    """The time that leaving takes is seen from outside."""
    os.kill(until_ready(pool, bodies()), signal.SIGSTOP)
    run(pool, bodies())
    return Finding(True, "")


def without_memory(pool: Candidate) -> Finding:
    import resource

    meshes = bodies()
    pid = until_ready(pool, meshes)
    resource.prlimit(pid, resource.RLIMIT_AS, (1 << 20, 1 << 20))
    same = is_same(run(pool, meshes), here(meshes))
    return Finding(same, "the same bits")


@contextlib.contextmanager
def starved(pid: int, runs: float = 0.002, rests: float = 0.06) -> Iterator[None]:
    """The process gets a thirtieth of its time."""
    ended = threading.Event()

    def take_turns() -> None:
        while not ended.wait(runs):
            os.kill(pid, signal.SIGSTOP)
            ended.wait(rests)
            os.kill(pid, signal.SIGCONT)

    thread = threading.Thread(target=take_turns)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def slow(pool: Candidate) -> Finding:
    meshes = bodies()
    pid = until_ready(pool, meshes)
    alone = statistics.median(seconds(lambda: here(meshes)) for _ in range(3))
    with starved(pid):
        found: list = []
        took = [seconds(lambda: found.append(run(pool, meshes))) for _ in range(5)]
    worst = max(took) / alone
    same = all(is_same(one, here(meshes)) for one in found)
    return Finding(same and worst < 4, f"{worst:.1f} times alone at worst")


def no_jax(pool: Candidate) -> Finding:
    pid = until_ready(pool, bodies())
    loaded = "jaxlib" in Path(f"/proc/{pid}/maps").read_text()
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    size = pages * os.sysconf("SC_PAGE_SIZE") / 1e6
    return Finding(not loaded, f"{'JAX' if loaded else 'no JAX'}, {size:.0f} MB")


def parent_killed(pool: Candidate) -> Finding:
    """What is left then is seen from outside."""
    print(json.dumps({"pid": until_ready(pool, bodies())}), flush=True)
    os.kill(os.getpid(), signal.SIGKILL)
    return Finding(False, "")


def forked(pool: Candidate) -> Finding:
    meshes = bodies()
    pid = until_ready(pool, meshes)
    child = os.fork()
    if child == 0:
        pool.leave_to_parent()
        os._exit(0 if is_same(run(pool, meshes[:4]), here(meshes[:4])) else 1)
    deadline = time.monotonic() + 30
    ended = 0, 0
    while ended[0] == 0 and time.monotonic() < deadline:
        ended = os.waitpid(child, os.WNOHANG)
        time.sleep(0.01)
    if ended[0] == 0:
        os.kill(child, signal.SIGKILL)
        os.waitpid(child, 0)
    fine = ended[0] == child and ended[1] == 0
    still = until_ready(pool, meshes) == pid
    what = "measures" if fine else "hangs" if ended[0] == 0 else "fails"
    return Finding(fine and still, f"the child {what}")


def speed(pool: Candidate) -> Finding:
    meshes = bodies()
    until_ready(pool, meshes)
    used = processor_time_of(pool)
    by_clock, by_cores = [], []
    for _ in range(15):
        start, begin = used(), time.perf_counter()
        here(meshes)
        middle, between = used(), time.perf_counter()
        run(pool, meshes)
        by_clock.append((between - begin) / (time.perf_counter() - between))
        by_cores.append(2 * (middle - start) / (used() - middle))
    clock, cores = statistics.median(by_clock), statistics.median(by_cores)
    return Finding(cores >= 1.65, f"{cores:.2f} by processor time, {clock:.2f} by the clock")


def first_call(pool: Candidate) -> Finding:
    meshes = bodies()
    here(meshes)
    alone = statistics.median(seconds(lambda: here(meshes)) for _ in range(3))
    first = seconds(lambda: run(pool, meshes))
    begin = time.perf_counter()
    until_ready(pool, meshes)
    ready = first + time.perf_counter() - begin
    late = 1e3 * (first - alone)
    return Finding(first < 2 * alone, f"{late:.0f} ms later; ready after {ready:.2f} s")


def processor_time_of(pool: Candidate) -> Callable[[], float]:
    """Seconds that this process and the worker have used."""
    import psutil

    worker = psutil.Process(pool.pid())

    def used() -> float:
        times = worker.cpu_times()
        return time.process_time() + times.user + times.system

    return used


def overhead(pool: Candidate) -> Finding:
    """Of handing a mesh over: processor time of all processes, beyond that of measuring here."""
    meshes = bodies()
    until_ready(pool, meshes)
    used = processor_time_of(pool)
    extra = []
    for _ in range(15):
        start = time.process_time()
        here(meshes)
        alone = time.process_time() - start
        before, start = pool.answered, used()
        run(pool, meshes)
        extra.append((used() - start - alone) / max(pool.answered - before, 1))
    middle = 1e3 * statistics.median(extra)
    return Finding(middle < 6.0, f"{middle:.1f} ms a mesh handed over")


def clean_exit(pool: Candidate) -> Finding:
    """What is left, and what is said, is seen from outside."""
    return Finding(is_same(run(pool, bodies(4)), here(bodies(4))), str(until_ready(pool, bodies())))


LAWS: dict[str, tuple[Callable[[Candidate], Finding], str]] = {
    "same bits": (same_bits, "as measured here"),
    "killed": (killed, "killed in a batch: the same bits, no wait, and another one starts"),
    "stopped": (stopped, "stopped: no wait, and it is used again when it goes on"),
    "slow": (slow, "gets a thirtieth of a core: no wait"),
    "memory": (without_memory, "starved of memory: the same bits"),
    "leaves": (leaves_with_stopped, "the program ends while it is stopped"),
    "no JAX": (no_jax, "no JAX in it, though the script imports it"),
    "guard": (no_jax, "the script runs once, though it has no `if __name__` guard"),
    "exit": (clean_exit, "a clean exit: nothing said, nothing left"),
    "orphan": (parent_killed, "it ends when the program is killed"),
    "fork": (forked, "a fork of the program measures"),
    "first call": (first_call, "the first batch does not wait for its start"),
    "overhead": (overhead, "what handing a mesh over costs, processor time"),
    "speed": (speed, "two cores 1.7 times as fast as one"),
}


def main() -> None:
    law, name = sys.argv[1:]
    assert jax.devices()
    pool = CANDIDATES[name]()
    atexit.register(pool.close)
    print(json.dumps(LAWS[law][0](pool)._asdict()), flush=True)


if __name__ == "__main__":
    main()
