"""Hours of everything at once: `python -m benchmarks.soak --minutes N`.

Eight threads call the penalty with options that are new every time, on meshes, faces and rest
surfaces that are new every time, inside and outside `jit`, in batches and on the device, set poses
and meshes free, fit poses, and drag joints in the live view. Resident memory, threads and processes
are read every second. It ends with 1 where memory grew after the first sixth of the time, where a
thread stood still or failed, or where a thread or process is left in the end.
"""

import gc
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import trimesh
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from spt_jax import (
    PinholeCamera,
    RestSurface,
    classify_vertices,
    clear_caches,
    fit_pose,
    load_body,
    load_mocap,
    self_intersection_penalty,
    untangle_mesh,
    untangle_pose,
)

# Of memory, from the end of the first sixth on (of an hour, ten minutes): the median of each tenth
# of the time that is left, against the first of them.
_GROWTH = 1.05
_WARMING = 1 / 6
# Samples, of one a second, without a single step, compiling included, after which a thread stands
# still. Not seconds: a machine that gives this process none takes no samples either.
_STANDSTILL = 600


@dataclass
class Settings:
    """How long, and what becomes of it."""

    minutes: float = 3.0
    seed: int = 0
    record: bool = False
    """Write the table into results.md."""


@dataclass
class Job:
    """One thread's work: a generator that does a little at every step."""

    name: str
    steps: Iterator[None]
    done: int = 0
    waited: int = 0
    error: str = ""

    def run(self, leaving: threading.Event) -> None:
        try:
            for _ in self.steps:
                self.done, self.waited = self.done + 1, 0
                if leaving.is_set():
                    return
        except Exception:
            self.error = traceback.format_exc()

    def stands_still(self) -> bool:
        """Whether it has not come on for long; asked once a second."""
        self.waited += 1
        return not self.error and self.waited > _STANDSTILL


class Sample(NamedTuple):
    """What the process held at one time."""

    seconds: float
    resident: int  # bytes, this process
    children: int  # bytes, the processes it started
    threads: int
    processes: int


def sampled(begin: float) -> Sample:
    """What this process and those that it started hold now, by /proc."""
    own = _status(os.getpid())
    children = [_status(pid) for pid in _children(os.getpid())]
    return Sample(
        time.monotonic() - begin,
        own["VmRSS"] * 1024,
        sum(one.get("VmRSS", 0) for one in children) * 1024,
        own["Threads"],
        len(children),
    )


def _status(pid: int) -> dict[str, int]:
    try:
        lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    except OSError:  # it has just ended
        return {}
    words = [line.split() for line in lines]
    return {w[0][:-1]: int(w[1]) for w in words if w and w[0] in ("VmRSS:", "Threads:")}


def _children(pid: int) -> list[int]:
    tasks = Path(f"/proc/{pid}/task").glob("*/children")
    return [int(child) for task in tasks for child in task.read_text().split()]


def _pair(rng: np.random.Generator, subdivisions: int = 1) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=subdivisions)
    other = ball.copy().apply_translation(rng.uniform(0.3, 0.9, 3))
    both = trimesh.util.concatenate([ball, other])
    assert isinstance(both, trimesh.Trimesh)
    return both


def _new_options(rng: np.random.Generator) -> Iterator[None]:
    """Directions, groups, margins and numbers of rays, outside jit."""
    while True:
        mesh = _pair(rng)
        count = len(mesh.faces)
        options = {
            "directions": rng.normal(size=(rng.integers(1, 4), 3)),
            "rays": (None, int(rng.integers(8, 64)))[rng.integers(2)],
            "margin": float(rng.choice([0.0, rng.uniform(0.0, 0.1)])),
            "face_groups": rng.permutation(np.repeat([0, 1], count // 2)),
            "ignore_groups": ((0, 1),),
        }
        loss = lambda v: self_intersection_penalty(v, mesh.faces, **options)  # noqa: B023, E731
        jax.block_until_ready(
            jax.value_and_grad(loss)(jax.device_put(mesh.vertices.astype(np.float32)))
        )
        yield


def _new_meshes(rng: np.random.Generator) -> Iterator[None]:
    """Faces, sizes and rest surfaces, outside jit."""
    while True:
        mesh = _pair(rng)
        extra = rng.normal(size=(rng.integers(0, 500), 3))
        vertices = jax.device_put(np.float32(np.concatenate([mesh.vertices, extra])))
        faces = rng.permutation(mesh.faces)
        rest = RestSurface(np.asarray(vertices), faces, distance=float(rng.uniform(0.01, 0.3)))
        classify_vertices(vertices, faces, rest_surface=rest)
        jax.block_until_ready(self_intersection_penalty(vertices, faces, rest_surface=rest))
        yield


def _poses(rng: np.random.Generator) -> Iterator[None]:
    """One program, a new pose and shape each time."""
    body, frames = load_body(), _frames()
    betas = body.num_shape

    @jax.jit
    def step(pose, shape):
        return jax.value_and_grad(
            lambda p: self_intersection_penalty(
                body(p, shape).vertices, body.faces, rest_surface=body.rest_surface
            )
        )(pose)

    while True:
        shape = jnp.asarray(rng.normal(size=betas), "float32")
        jax.block_until_ready(step(frames[rng.integers(len(frames))], shape))
        yield


def _batches(rng: np.random.Generator) -> Iterator[None]:
    """Six bodies at once, shared with other processes."""
    body, frames = load_body(), _frames()
    many = jax.jit(jax.vmap(jax.value_and_grad(lambda v: self_intersection_penalty(v, body.faces))))
    while True:
        pose = frames[rng.integers(len(frames), size=6)]
        jax.block_until_ready(many(body(pose).vertices))
        yield


def _programs(rng: np.random.Generator) -> Iterator[None]:
    """A function that is traced and compiled anew each time, as in a notebook."""
    while True:
        mesh = _pair(rng)
        turn = rng.normal(size=(3, 3))
        step = jax.jit(
            lambda v: self_intersection_penalty(v, mesh.faces, rays=16, directions=turn)  # noqa: B023
        )
        jax.block_until_ready(step(jax.device_put(mesh.vertices.astype(np.float32))))
        yield


def _untangled(rng: np.random.Generator) -> Iterator[None]:
    body, frames = load_body(), _frames()
    while True:
        untangle_pose(body, frames[rng.integers(len(frames))])
        yield
        mesh = _pair(rng, 2)
        untangle_mesh(mesh.vertices.astype(np.float32), mesh.faces)
        yield


def _fitted(rng: np.random.Generator) -> Iterator[None]:
    body, frames = load_body(), _frames()
    camera = PinholeCamera(1200.0, (500.0, 500.0), translation=(0.0, 0.0, 4.0))
    while True:
        pose = frames[rng.integers(len(frames))].at[0].set(jnp.array([jnp.pi, 0.0, 0.0]))
        seen = camera.project(body(pose).joints[:22]) + rng.normal(scale=3.0, size=(22, 2))
        fit_pose(body, seen, camera, layout="smpl")
        yield


def _viewed(rng: np.random.Generator) -> Iterator[None]:
    """A view that is served; joints are turned and untangled as by its panel."""
    from spt_jax.view.server import View

    view = View(None, port=0)
    view.start()
    try:
        while True:
            for _ in range(20):
                view.turn_axis(int(rng.integers(52)), int(rng.integers(3)), rng.uniform(-90, 90))
                time.sleep(0.05)
            view.count_folds(bool(rng.integers(2)))
            view.reset()
            while not view.worker.wait_until_idle(60.0):
                pass
            yield
    finally:
        view.stop_serving()


def _frames() -> jax.Array:
    body, mocap = load_body(), load_mocap()
    chosen = np.linspace(0, len(mocap.names) - 1, 60).astype(int)
    return body.pose_from_smpl(jnp.asarray(mocap.pose[chosen]))


WORK: dict[str, Callable[[np.random.Generator], Iterator[None]]] = {
    "new options": _new_options,
    "new meshes and rest surfaces": _new_meshes,
    "poses": _poses,
    "batches": _batches,
    "new programs": _programs,
    "untangle": _untangled,
    "fit": _fitted,
    "view": _viewed,
}


def soaked(settings: Settings) -> tuple[list[Job], list[Sample], Sample, Sample]:
    """Do it: the jobs, the samples, and what was held before and after."""
    seeds = np.random.SeedSequence(settings.seed).spawn(len(WORK))
    leaving, begin = threading.Event(), time.monotonic()
    before = sampled(begin)
    jobs = [
        Job(name, work(np.random.default_rng(seed)))
        for (name, work), seed in zip(WORK.items(), seeds, strict=True)
    ]
    threads = [
        threading.Thread(target=job.run, args=(leaving,), name=job.name, daemon=True)
        for job in jobs
    ]
    for thread in threads:
        thread.start()
    samples, length = [], 60 * settings.minutes
    with progress() as bar:
        task = bar.add_task("soak", total=int(length))
        while time.monotonic() - begin < length:
            time.sleep(1.0)
            samples.append(sampled(begin))
            bar.update(task, completed=int(samples[-1].seconds))
            still = [job for job in jobs if job.stands_still()]
            if still or any(job.error for job in jobs):
                break
    leaving.set()
    for thread, job in zip(threads, jobs, strict=True):
        while thread.is_alive() and not job.stands_still():
            thread.join(1.0)
        if not thread.is_alive():
            job.steps.close()  # type: ignore[attr-defined]  # the view's
    clear_caches()
    gc.collect()
    time.sleep(2.0)
    return jobs, samples, before, sampled(begin)


def growth_of(samples: list[Sample]) -> float:
    """The most resident memory of any tenth of the time over that just after the first sixth."""
    end = samples[-1].seconds
    kept = [one for one in samples if one.seconds >= _WARMING * end]
    resident = np.array([one.resident + one.children for one in kept], float)
    tenths = [np.median(part) for part in np.array_split(resident, min(10, len(resident)))]
    return float(max(tenths) / tenths[0])


def main(settings: Settings) -> int:
    """Run, print and perhaps record; what is wrong is printed to standard error."""
    jobs, samples, before, after = soaked(settings)
    growth = growth_of(samples)
    mega = lambda count: f"{count / 1e6:.0f} MB"  # noqa: E731
    work = Table(
        "What was done",
        ["thread", "steps"],
        [[job.name, f"{job.done:,}"] for job in jobs],
    )
    marks = np.linspace(_WARMING, 1.0, 6) * (len(samples) - 1)
    shown = [("before", before)]
    shown += [(f"after {samples[int(k)].seconds / 60:.1f} min", samples[int(k)]) for k in marks]
    shown += [("in the end, caches cleared", after)]
    held = Table(
        f"What was held; memory grew by {100 * (growth - 1):+.1f} % after the first sixth",
        ["when", "resident", "other processes", "threads", "processes"],
        [
            [name, mega(one.resident), mega(one.children), str(one.threads), str(one.processes)]
            for name, one in shown
        ],
    )
    for table in (work, held):
        table.print()
    faults = [f"{job.name} failed:\n{job.error}" for job in jobs if job.error]
    faults += [
        f"{job.name} stood still for {job.waited} s" for job in jobs if job.waited > _STANDSTILL
    ]
    if growth > _GROWTH:
        faults.append(f"memory grew by {100 * (growth - 1):.1f} %; at most 5 % is allowed")
    left = {one.name for one in threading.enumerate()} & {job.name for job in jobs}
    if left or after.processes > before.processes:
        faults.append(f"left behind: threads {sorted(left)}, {after.processes} processes")
    for fault in faults:
        print(f"soak: {fault}", file=sys.stderr)
    if settings.record:
        body = "\n\n".join(
            [
                provenance(f"python -m benchmarks.soak --minutes {settings.minutes:g}"),
                work.markdown(),
                held.markdown(),
                "\n".join(f"- {fault}" for fault in faults) or "Nothing failed or stood still.",
            ]
        )
        record_section("soak", "Hours of everything at once", body)
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(tyro.cli(Settings, description=__doc__)))
