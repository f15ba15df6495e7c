"""Motions freed as a whole, frame by frame, and smoothed: `python -m benchmarks.untangle_motion`.

Each motion at its own rate and interpolated to four times that, as splines of rotations; sequences
with other shapes made from them; and scenes of two people. Whether a frame is free is ipctk's to
say (`oracles.py`), of 30 frames a second, in scenes the package's own; how smooth a motion is, is
measured by the second differences of its skin's vertices.
"""

import multiprocessing
import os
import pickle
import time
from collections import Counter
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np
import tyro
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, RotationSpline

from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.oracles import FAR, RestGraph, far_crossings
from spt_jax import load_body, load_mocap, untangle_motion, untangle_pose
from spt_jax.untangle.corrections import Frames, corrected, posed
from spt_jax.untangle.feet import standing_feet

# What the recordings are taken for, in frames a second.
RATE = 30
# Of the Gaussian over the correction, in seconds.
SMOOTHED = 0.05
# At four times the rate, of the subset.
SUBSET = ("run", "backflip", "walk")
METHODS = ("as a whole", "frame by frame", "frame by frame, smoothed")


@dataclass
class Settings:
    """Which motions are freed."""

    motions: tuple[str, ...] = ()
    """By name; none: all eleven."""
    finer: tuple[int, ...] = (1, 4)
    """How many times as many frames a second."""
    shapes: int = 20
    """How many sequences with shapes of up to two standard deviations either way."""
    scenes: int = 3
    """How many scenes of two people."""
    subset: bool = False
    """In place of all that: what takes a quarter of an hour on two idle cores."""
    processes: int = 2
    """Each on one core, with motions of its own."""
    kept: Path | None = None
    """A folder in which what is done is kept, and found again."""
    again: bool = False
    """Of what is kept, free motions as a whole again; what was made frame by frame stays."""
    record: bool = False
    """Write the tables into results.md."""


class Freed(NamedTuple):
    """What one way made of one motion; lengths in metres.

    Attributes:
        free: of the frames that were judged, which have no far crossing.
        largest: of each frame but two, the largest second difference of a vertex.
        moved: of each frame, the mean displacement of the vertices.
        slide: of each frame but one in which a foot stands, how much farther than in the motion
            given it went.
        seconds: of one core, over all frames.
    """

    free: np.ndarray
    largest: np.ndarray
    moved: np.ndarray
    slide: np.ndarray
    seconds: float


class Task(NamedTuple):
    """What is freed: a motion at so many times its rate, with the mean shape or another one."""

    name: str
    finer: int
    seed: int | None
    kept: Path | None
    again: bool = False

    @property
    def path(self) -> Path | None:
        """Where it is kept."""
        shape = "" if self.seed is None else f"_shape{self.seed}"
        return None if self.kept is None else self.kept / f"{self.name}_{self.finer}{shape}.pkl"


class Done(NamedTuple):
    """One motion at one rate, and what became of it."""

    name: str
    rate: int
    seed: int | None
    colliding: np.ndarray
    largest: np.ndarray
    rejected: tuple[bool, bool]
    ways: dict[str, Freed]


@cache
def _world():
    if hasattr(os, "sched_setaffinity"):  # one core: no workers, and its time is all the time
        os.sched_setaffinity(0, {sorted(os.sched_getaffinity(0))[os.getpid() % 2]})
    body = load_body()
    graph = RestGraph.of_body(body)
    warm = motion("cartwheel", 1)[100:104]
    untangle_motion(body, warm)
    untangle_pose(body, warm[0])
    return body, np.asarray(body.faces, np.int64), graph


def motion(name: str, finer: int) -> np.ndarray:
    """The poses of a motion, interpolated."""
    mocap = load_mocap()
    chosen = [k for k, one in enumerate(mocap.names) if one.split("/")[0] == name]
    pose = np.asarray(load_body().pose_from_smpl(jnp.asarray(mocap.pose[chosen])))
    if finer == 1:
        return pose
    known, wanted = np.arange(len(pose)), np.arange((len(pose) - 1) * finer + 1) / finer
    found = np.zeros((len(wanted), *pose.shape[1:]))
    for joint in range(pose.shape[1]):
        if pose[:, joint].any():
            spline = RotationSpline(known, Rotation.from_rotvec(pose[:, joint]))
            found[:, joint] = spline(wanted).as_rotvec()
    return found.astype(np.float32)


def shape_of(seed: int | None) -> np.ndarray:
    """A body's shape: the mean one, or components drawn from two standard deviations either way."""
    count = _world()[0].num_shape
    if seed is None:
        return np.zeros(count, np.float32)
    return np.random.default_rng(seed).uniform(-2, 2, count).astype(np.float32)


def freed(task: Task) -> Done:
    """One motion in all three ways."""
    known: Done | None = None
    if task.path is not None and task.path.exists():
        known = pickle.loads(task.path.read_bytes())
        if known is not None and not task.again:
            return known
    name, finer = task.name, task.finer
    body, _, _ = _world()
    given, rate, shape = motion(name, finer), RATE * finer, shape_of(task.seed)
    start = time.process_time()
    whole = untangle_motion(body, given, shape=shape, frames_per_second=rate)
    middle = time.process_time()
    found = {METHODS[0]: (np.asarray(whole.pose), middle - start)}
    if known is None:
        single = np.array(untangle_pose(body, jnp.asarray(given), shape=jnp.asarray(shape)).pose)
        seconds = time.process_time() - middle
        found[METHODS[1]] = single, seconds
        found[METHODS[2]] = _smoothed(given, single, SMOOTHED * rate), seconds
    vertices = _vertices(given, shape)
    standing = standing_feet(
        body, _frames(given, shape), float(rate), np.array([0.0, 1.0, 0.0]), on_ground=False
    )
    judged = np.arange(finer // 2, len(given), finer)
    before = _far(vertices[judged])
    done = Done(
        name,
        rate,
        task.seed,
        ~whole.before.is_free,
        _largest(vertices),
        (whole.before.is_rejected, whole.after.is_rejected),
        {
            **({} if known is None else known.ways),
            **{
                way: _judged(given, *one, shape, vertices, standing, judged, before)
                for way, one in found.items()
            },
        },
    )
    if task.path is not None:
        task.path.write_bytes(pickle.dumps(done))
    return done


class Scene(NamedTuple):
    """Two people, and what became of them; lengths in metres."""

    names: tuple[str, str]
    frames: int
    within: tuple[int, int]
    between: tuple[int, int]
    left: int
    ratio: tuple[float, float]
    moved: float
    seconds: float


# Motions that are there at the same time, and how far the second person stands to the side.
SCENES = (("walk", "run", 0.35), ("spinkick", "jump", 0.45), ("punch", "dance_a", 0.4))


def _left(overlaps) -> tuple[int, int]:
    """Frames with intersections, before and after."""
    before, after = (int((~overlap.is_free).sum()) for overlap in overlaps)
    return before, after


def scene(task: tuple[int, Path | None, bool]) -> Scene:
    """One scene of two people, of the first second and a half."""
    number, kept, again = task
    path = None if kept is None else kept / f"scene_{number}.pkl"
    if path is not None and path.exists() and not again:
        return pickle.loads(path.read_bytes())
    body, _, _ = _world()
    first, second, apart = SCENES[number]
    both = [motion(name, 1)[:45] for name in (first, second)]
    count = min(map(len, both))
    pose = np.stack([one[:count] for one in both], axis=1)
    places = np.zeros((count, 2, 3), np.float32)
    places[:, 1, 0] = apart
    start = time.process_time()
    found = untangle_motion(body, pose, translation=places)
    seconds = time.process_time() - start
    frames = Frames(pose, np.zeros((count, 2, body.num_shape), np.float32), places)
    before, after = (
        _posed(frames._replace(pose=np.asarray(poses))) for poses in (pose, found.pose)
    )
    hit = ~found.before.is_free
    largest = _largest(before), _largest(after)
    assert found.within is not None and found.between is not None  # two people
    done = Scene(
        (first, second),
        count,
        _left(found.within),
        _left(found.between),
        int((~np.asarray(found.is_free)).sum()),
        (
            largest[1].max() / largest[0].max(),
            np.quantile(largest[1], 0.95) / np.quantile(largest[0], 0.95),
        ),
        float(np.linalg.norm(after - before, axis=-1).mean(axis=1)[hit].mean()) if hit.any() else 0,
        seconds,
    )
    if path is not None:
        path.write_bytes(pickle.dumps(done))
    return done


def _judged(given, pose: np.ndarray, seconds, shape, vertices, standing, judged, before) -> Freed:
    after = _vertices(pose, shape)
    free = before == 0
    changed = np.any(pose != given, axis=(1, 2))[judged]
    free[changed] = _far(after[judged][changed]) == 0
    slide = []
    for foot, share in zip(standing.feet, standing.share[:, 0].T, strict=True):
        step = [
            np.linalg.norm(np.diff(v[:, foot].mean(axis=1), axis=0), axis=1)
            for v in (vertices, after)
        ]
        slide.append((step[1] - step[0])[(share[1:] > 0) & (share[:-1] > 0)])
    moved = np.linalg.norm(after - vertices, axis=-1).mean(axis=1)
    return Freed(free, _largest(after), moved, np.concatenate(slide), seconds)


def _far(vertices) -> np.ndarray:
    _, faces, graph = _world()
    return np.array([far_crossings(v.astype(np.float64), faces, graph).num_far for v in vertices])


def _smoothed(given, pose, sigma: float) -> np.ndarray:
    """The motion given with the correction of each frame smoothed over time."""
    turn = np.zeros_like(given[:, 1:])
    for joint in range(1, given.shape[1]):
        first, second = (
            Rotation.from_rotvec(p[:, joint].astype(np.float64)) for p in (given, pose)
        )
        turn[:, joint - 1] = (first.inv() * second).as_rotvec()
    smooth = gaussian_filter1d(turn, sigma, axis=0, mode="nearest")
    found = np.asarray(corrected(jnp.asarray(given), jnp.asarray(smooth)))
    return np.where(np.any(smooth != 0, axis=(1, 2), keepdims=True), found, given)


def _frames(pose, shape) -> Frames:
    return Frames(
        pose[:, None],
        np.tile(shape, (len(pose), 1, 1)),
        np.zeros((len(pose), 1, 3), np.float32),
    )


def _vertices(pose, shape) -> np.ndarray:
    return _posed(_frames(pose, shape))


def _posed(frames: Frames) -> np.ndarray:
    body = _world()[0]
    return np.concatenate([np.asarray(posed(body, b))[:n] for n, b in frames.batches()])


def _largest(vertices) -> np.ndarray:
    return np.linalg.norm(np.diff(vertices, n=2, axis=0), axis=-1).max(axis=1, initial=0.0)


def tables(runs: list[Done]) -> list[Table]:
    """Each rate's motions: summed up by way, and one by one."""
    found = []
    for rate in sorted({run.rate for run in runs}):
        these = [run for run in runs if run.rate == rate and run.seed is None]
        found += [_summary(f"{len(these)} motions", rate, these), _each(rate, these)]
    shaped = [run for run in runs if run.seed is not None]
    if shaped:
        found.append(_summary(f"{len(shaped)} sequences with other shapes", RATE, shaped))
    return found


def _scenes(scenes: list[Scene]) -> Table:
    rows = [
        (
            " beside ".join(one.names),
            str(one.frames),
            f"{one.within[0]}, {one.within[1]}",
            f"{one.between[0]}, {one.between[1]}",
            f"{one.frames - one.left}",
            f"{one.ratio[0]:.2f}, {one.ratio[1]:.2f}",
            f"{1e3 * one.moved:.1f}",
            f"{2 * one.frames / one.seconds:.1f}",
        )
        for one in scenes
    ]
    return Table(
        "Two people as one scene, freed together",
        (
            "people",
            "frames",
            "collide within people, before and after",
            "between people",
            "free afterwards",
            "second difference, after / before: largest, 95 % quantile",
            "mean displacement of colliding frames, mm",
            "frames a second on two cores",
        ),
        rows,
    )


def _ratios(run: Done, way: str) -> tuple[float, float]:
    after = run.ways[way].largest
    return after.max() / run.largest.max(), np.quantile(after, 0.95) / np.quantile(
        run.largest, 0.95
    )


def _summary(what: str, rate: int, runs: list[Done]) -> Table:
    frames = sum(len(run.colliding) for run in runs)
    touched = [run for run in runs if run.colliding.any()]
    rows = []
    for way in METHODS:
        ways = [run.ways[way] for run in runs]
        free = np.concatenate([one.free for one in ways])
        ratio = np.array([_ratios(run, way) for run in touched])
        here = np.concatenate([run.ways[way].moved[run.colliding] for run in touched])
        everywhere = np.concatenate([one.moved for one in ways])
        slide = np.concatenate([one.slide for one in ways])
        speed = np.median([2 * len(run.colliding) / run.ways[way].seconds for run in touched])
        rows.append(
            (
                way,
                f"{free.mean():.2%} of {len(free)}",
                f"{ratio[:, 0].max():.2f}",
                f"{ratio[:, 1].max():.2f}",
                f"{1e3 * here.mean():.1f}",
                f"{1e3 * everywhere.mean():.2f}",
                f"{1e3 * slide.max(initial=0.0):.2f}",
                f"{speed:.1f}",
            )
        )
    rejected = [sum(run.rejected[k] for run in runs) for k in (0, 1)]
    return Table(
        f"{what} at {rate} frames a second, {frames} frames, "
        f"{sum(int(run.colliding.sum()) for run in runs)} collide; the public rule leaves out "
        f"{rejected[0]} of the motions before and {rejected[1]} after being freed as a whole",
        (
            "way",
            f"frames without a crossing farther than {FAR:g} m",
            "largest second difference, after / before, worst motion",
            "95 % quantile over frames, likewise",
            "mean displacement of colliding frames, mm",
            "of all frames, mm",
            "a standing foot's step longer by at most, mm a frame",
            "frames a second on two cores, median",
        ),
        rows,
    )


def _each(rate: int, runs: list[Done]) -> Table:
    rows = []
    for run in runs:
        for way in METHODS:
            one, ratio = run.ways[way], _ratios(run, way)
            here = one.moved[run.colliding]
            rows.append(
                (
                    f"{run.name}, {way}",
                    f"{int(run.colliding.sum())} of {len(run.colliding)}",
                    f"{int(one.free.sum())} of {len(one.free)}",
                    f"{1e3 * run.largest.max():.1f}",
                    f"{1e3 * one.largest.max():.1f}",
                    f"{ratio[1]:.2f}",
                    f"{1e3 * here.mean() if len(here) else 0:.1f}",
                    f"{2 * len(run.colliding) / one.seconds:.1f}",
                )
            )
    return Table(
        f"Motion by motion, {rate} frames a second",
        (
            "motion",
            "frames that collide",
            "free afterwards, of those judged",
            "largest second difference before, mm",
            "after",
            "95 % quantile, after / before",
            "mean displacement of colliding frames, mm",
            "frames a second",
        ),
        rows,
    )


def main(settings: Settings) -> None:
    """Free the motions and print the tables."""
    lengths = Counter(name.split("/")[0] for name in load_mocap().names)
    names = settings.motions or tuple(sorted(lengths, key=lambda name: lengths[name]))
    if settings.kept is not None:
        settings.kept.mkdir(parents=True, exist_ok=True)
    kept = settings.kept, settings.again
    tasks = [Task(name, finer, None, *kept) for finer in settings.finer for name in names]
    shapes, scenes = settings.shapes, list(range(min(settings.scenes, len(SCENES))))
    if settings.subset:
        tasks = [Task(name, 1, None, *kept) for name in names]
        tasks += [Task(name, 4, None, *kept) for name in names if name in SUBSET]
        shapes, scenes = 4, [0]
    tasks += [Task(names[seed % len(names)], 1, seed, *kept) for seed in range(shapes)]
    runs, found = [], []
    # Forked processes would inherit JAX's threads without the threads.
    context = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(settings.processes, mp_context=context) as pool, progress() as bar:
        shown = bar.add_task("freeing", total=len(tasks))
        for run in pool.map(freed, tasks):
            runs.append(run)
            bar.advance(shown)
        found = list(pool.map(scene, [(number, *kept) for number in scenes]))
    parts = tables(runs)
    if found:
        parts.append(_scenes(found))
    for table in parts:
        table.print()
    if settings.record:
        chosen = "".join(f" --motions {' '.join(settings.motions)}" if settings.motions else "")
        how = (
            "--subset"
            if settings.subset
            else f"--finer {' '.join(map(str, settings.finer))} --shapes {settings.shapes} "
            f"--scenes {settings.scenes}"
        )
        if settings.again:
            how += " --kept FOLDER --again"
        command = f"python -m benchmarks.untangle_motion{chosen} {how} --record"
        record_section("untangle_motion", "Untangling motions", _text(command, parts))


def _text(command: str, parts: list[Table]) -> str:
    return "\n\n".join(
        [
            provenance(command),
            "Default settings. Second differences are those of the skin's vertices from frame to "
            "frame; the recordings have no place of the root, so feet stand where they are within "
            f"5 cm of the lowest vertex. Smoothed: a Gaussian of {SMOOTHED:g} s over the turns "
            "that freed each frame. Times are of one core a motion, after compiling, in processor "
            "time. With --again, what was made frame by frame is that of the run before.",
            *(table.markdown() for table in parts),
        ]
    )


if __name__ == "__main__":
    main(tyro.cli(Settings))
