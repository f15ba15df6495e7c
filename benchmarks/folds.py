"""Whether folds are distinguished from collisions, and how well: `python -m benchmarks.folds`.

The oracle looks at triangles alone (`oracles.py`): a frame collides where an edge crosses a
triangle that is farther along the rest surface than what lies there may fold, 0.3 m on trunk and
limbs. There the volume without folds should be positive; elsewhere it should be nothing. So for 41
poses of hands (`tests/data/hands.json`), where 5 cm are far.

Then the laws that such a volume obeys, on colliding frames and along straight motions, for the
measure as built, for others that it was chosen from (`fold_candidates.py`), and for an earlier
tree's rays.
"""

import json
import tempfile
import time
from collections.abc import Callable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import numpy as np
import tyro

from benchmarks.against import Worker, checked_out
from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.fold_candidates import (
    Pieces,
    Ramp,
    as_built,
    by_field,
    judged_of,
    pieces_of,
    slope_with_shares_held,
)
from benchmarks.oracles import FAR, RestGraph, far_crossings
from spt_jax import load_body, load_mocap, self_intersection_penalty
from spt_jax.rest.surface import local_distances

_WORKER = Path(__file__).with_name("folds_worker.py")
NOTHING = 0.0  # m^3: the law, not a tolerance
LEAST_SEEN, LEAST_SILENT = 1.0, 1.0
HANDS = Path(__file__).resolve().parents[1] / "tests" / "data" / "hands.json"
# What intersects farther apart than a finger is thick around is no crease.
HANDS_FAR = 0.05
# From each frame towards the other, in steps of so many metres in the mean over the vertices.
PATHS = {
    "spinkick/0058": "spinkick/0040",
    "roll/0052": "roll/0040",
    "punch/0013": "punch/0020",
}
STEP = 0.0005
# Of the largest step to the median one.
MOST_RATIO = 10.0


@dataclass
class Settings:
    """Which frames are measured."""

    frames: int = 300
    """Up to 1,086, which is all of them."""
    seed: int = 0
    colliding: int = 12
    """Of the colliding frames, how many the laws are measured on."""
    motions: int = 6
    """Straight motions, from colliding frames to others, besides three that are always there."""
    steps: int = 200
    """Of each motion."""
    earlier: str = "19dbbc9"
    """A commit whose rays the candidates are compared with; empty for none."""
    record: bool = False
    """Write the tables into results.md."""


class Frame(NamedTuple):
    """One frame: what the oracle sees (crossings, far ones, the largest distance), and volumes."""

    name: str
    crossings: int
    far: int
    distance: float
    collision: float
    total: float


def penalties(body):
    """A compiled function of a pose: vertices, volume without folds, volume with them."""

    def both(pose):
        vertices = body(pose).vertices
        collision = self_intersection_penalty(vertices, body.faces, rest_surface=body.rest_surface)
        return vertices, collision, self_intersection_penalty(vertices, body.faces)

    return jax.jit(both)


def measured(settings: Settings) -> list[Frame]:
    """The frames of a seeded shuffle, each with its crossings and volumes."""
    body, mocap = load_body(), load_mocap()
    faces = np.asarray(body.faces, np.int64)
    graph = RestGraph.of_body(body)
    volumes = penalties(body)
    chosen = np.random.default_rng(settings.seed).permutation(len(mocap.names))[: settings.frames]
    found = []
    with progress() as bar:
        for frame in bar.track(chosen, description="crossing"):
            vertices, collision, total = volumes(body.pose_from_smpl(mocap.pose[frame]))
            far = far_crossings(np.asarray(vertices, np.float64), faces, graph)
            found.append(
                Frame(
                    mocap.names[frame],
                    far.count,
                    far.num_far,
                    far.largest,
                    float(collision),
                    float(total),
                )
            )
    return found


def exceptions(title: str, frames: Sequence[Frame]) -> Table:
    """The frames that fall short, the largest volume first."""
    ordered = sorted(frames, key=lambda frame: (-frame.collision, -frame.far))
    return Table(
        title,
        ("frame", "crossings", "far ones", "farthest, m", "without folds, m^3", "in all, m^3"),
        [
            (
                frame.name,
                str(frame.crossings),
                str(frame.far),
                f"{frame.distance:.3f}",
                f"{frame.collision:.3g}",
                f"{frame.total:.3g}",
            )
            for frame in ordered
        ],
    )


def share(part: Sequence[Frame], whole: Sequence[Frame]) -> str:
    """How many frames of how many, and the share."""
    return f"{len(part)} of {len(whole)}" + (f" ({len(part) / len(whole):.1%})" if whole else "")


def tables(frames: Sequence[Frame]) -> list[Table]:
    """Agreement with the oracle, how large the volumes are, and the exceptions of either kind."""
    colliding = [frame for frame in frames if frame.far]
    folded = [frame for frame in frames if not frame.far and frame.crossings]
    clear = [frame for frame in frames if not frame.crossings]
    without = folded + clear
    unseen = [frame for frame in colliding if not frame.collision > 0]
    loud = [frame for frame in without if not frame.collision <= NOTHING]
    agreement = Table(
        f"{len(frames)} mocap frames: the volume without folds against edge-triangle crossings",
        ("where", "should be", "is so", "target"),
        [
            (
                f"a crossing is far, {FAR:g} m on trunk and limbs",
                "positive",
                share([frame for frame in colliding if frame.collision > 0], colliding),
                f"{LEAST_SEEN:.0%}",
            ),
            (
                "no crossing is",
                "exactly 0",
                share([frame for frame in without if frame.collision <= NOTHING], without),
                f"{LEAST_SILENT:.0%}",
            ),
            *(
                (
                    f"of those: {name}",
                    "the same",
                    share([frame for frame in kind if frame.collision <= NOTHING], kind),
                    "",
                )
                for name, kind in (("near crossings only", folded), ("no crossing at all", clear))
            ),
        ],
    )
    sizes = Table(
        "Volumes, cm^3",
        ("where", "measured", "median", "90 %", "maximum"),
        [
            (name, what, *(f"{1e6 * x:.3g}" for x in np.percentile(values, [50, 90, 100])))
            for name, kind in (("far crossing", colliding), ("near crossings only", folded))
            for what, values in (
                ("without folds", [frame.collision for frame in kind]),
                ("in all", [frame.total for frame in kind]),
            )
            if kind
        ],
    )
    found = [agreement, sizes]
    if unseen:
        found.append(exceptions("A far crossing, but no volume", unseen))
    if loud:
        found.append(exceptions("No far crossing, but a volume", loud))
    return found


def hand_table() -> Table:
    """The library of hands, with distances by place, of one size, and from local thickness."""
    body = load_body()
    faces = np.asarray(body.faces, np.int64)
    template = np.asarray(body.template, np.float64)
    graph = RestGraph.of(template, faces, HANDS_FAR)
    rest = body.rest_surface
    surfaces = {
        "by place, as bodies have it": rest,
        f"{FAR:g} m everywhere": rest.within(FAR),
        "local_distances": rest.within(local_distances(template, faces)),
        "local_distances, half the girth": rest.within(local_distances(template, faces, 0.5)),
    }
    posed = jax.jit(lambda pose: body(pose).vertices)
    right: dict[str, dict[str, list[float]]] = {name: {} for name in surfaces}
    for kind, library in json.loads(HANDS.read_text()).items():
        for rows in library.values():
            pose = np.zeros((body.num_joints, 3), np.float32)
            for name, angles in rows.items():
                pose[body.joint_names.index(f"left_{name}")] = angles
            vertices = np.asarray(posed(pose), np.float64)
            if bool(far_crossings(vertices, faces, graph).num_far) != (kind == "colliding"):
                raise ValueError(f"the oracle must agree with the library: got {kind}, {rows}.")
            for name, surface in surfaces.items():
                volume = as_built(pieces_of(vertices, faces, surface))
                right[name].setdefault(kind, []).append(volume)
    return Table(
        "41 poses of a hand: verdicts against ipctk's crossings of more than 5 cm",
        (
            "distances",
            "collide, and are included",
            "do not, and are excluded",
            "median volume, cm^3",
        ),
        [
            (
                name,
                f"{sum(v > 0 for v in found['colliding'])} of {len(found['colliding'])}",
                f"{sum(v == 0 for v in found['free'])} of {len(found['free'])}",
                f"{1e6 * np.median(found['colliding']):.2f}",
            )
            for name, found in right.items()
        ],
    )


class Candidate(NamedTuple):
    """One way to measure, given vertices (N, V, 3): volumes, and milliseconds for each mesh."""

    name: str
    measure: Callable[[np.ndarray], tuple[list[float], float]]


def candidates(earlier: Worker | None, folder: Path) -> list[Candidate]:
    """As built and the others; those of this tree share the time of finding what intersects."""
    body = load_body()
    faces, rest = np.asarray(body.faces, np.int64), body.rest_surface

    def own(value: Callable[[Pieces], float]):
        def measure(meshes: np.ndarray):
            found, taken = [], 0.0
            for vertices in meshes:
                start = time.perf_counter()
                found.append(value(pieces_of(vertices, faces, rest)))
                taken += time.perf_counter() - start
            return found, 1e3 * taken / len(meshes)

        return measure

    def before(meshes: np.ndarray):
        file = folder / "meshes.npz"
        np.savez(file, vertices=meshes)
        volumes, seconds = earlier.measure(str(file)) if earlier else ([], 0.0)
        return volumes, 1e3 * seconds

    ramp = Ramp(rest)
    found = [
        Candidate("(a) as built: share of the contour that is far", own(as_built)),
        Candidate("(a) with a ramp from 1 to 1.5 times the distance", own(ramp)),
        Candidate("(b) field of the region's own contour, sampled", own(by_field)),
        Candidate("(b) field of all contours, sampled", own(lambda p: by_field(p, True))),
    ]
    if earlier is not None:
        found.append(Candidate("rays of the earlier tree, 0.3 m everywhere", before))
    return found


def motion(start: str, end: str, steps: int) -> np.ndarray:
    """Vertices (N, V, 3) on the straight way from one pose to another, half a millimetre apart."""
    body, mocap = load_body(), load_mocap()
    names = list(mocap.names)
    posed = jax.jit(lambda pose: body(pose).vertices)
    p, q = (
        np.asarray(body.pose_from_smpl(mocap.pose[names.index(name)]), np.float32)
        for name in (start, end)
    )
    near = np.asarray(posed(p + np.float32(0.01) * (q - p)), np.float64) - np.asarray(posed(p))
    speed = np.linalg.norm(near, axis=1).mean() / 0.01
    along = (np.arange(steps + 1) * STEP / speed).astype(np.float32)
    return np.stack([np.asarray(posed(p + t * (q - p)), np.float64) for t in along])


def motions(settings: Settings, frames: Sequence[Frame]) -> dict[str, str]:
    """The ways from colliding frames to others, by name."""
    rng = np.random.default_rng(settings.seed)
    colliding = [frame.name for frame in frames if frame.far and frame.name not in PATHS]
    others = list(load_mocap().names)
    more = {name: others[rng.integers(len(others))] for name in colliding[: settings.motions]}
    return PATHS | more


def roughness(volumes: Sequence[float]) -> tuple[float, float, float, float]:
    """The median step and the largest, their ratio, and the largest jump as a part of the volume.

    Steps are those during which there is a volume. A jump is what a step has that the mean of its
    neighbors has not: a volume that falls smoothly to nothing has steps of very different sizes,
    and no jump.
    """
    volume = np.array(volumes)
    change = np.diff(volume)
    steps = np.abs(change)[(volume[1:] > 0) | (volume[:-1] > 0)]
    if not len(steps):
        return 0.0, 0.0, 0.0, 0.0
    middle = float(np.median(steps))
    jump = np.abs(change[1:-1] - (change[:-2] + change[2:]) / 2).max(initial=0.0)
    ratio = float(steps.max() / middle) if middle > 0 else np.inf
    return middle, float(steps.max()), ratio, float(jump / volume.max())


def continuity(settings: Settings, frames: Sequence[Frame], found: list[Candidate]) -> list[Table]:
    """L5: how the volume changes along straight motions."""
    rows, summary = [], {candidate.name: [] for candidate in found}
    for start, end in motions(settings, frames).items():
        meshes = motion(start, end, settings.steps)
        for candidate in found:
            volumes, taken = candidate.measure(meshes)
            middle, largest, ratio, jump = roughness(volumes)
            summary[candidate.name].append((ratio, jump, taken))
            ends = f"{1e6 * volumes[0]:.1f} to {1e6 * volumes[-1]:.1f}"
            figures = (f"{1e6 * middle:.3g}", f"{1e6 * largest:.3g}", f"{ratio:.1f}", f"{jump:.1%}")
            rows.append((f"{start} to {end}", candidate.name, ends, *figures))
    each = Table(
        f"Along straight motions of {settings.steps} steps of 0.5 mm: volumes, cm^3",
        ("motion", "measure", "from, to", "median step", "largest step", "ratio", "largest jump"),
        rows,
    )
    together = []
    for name, values in summary.items():
        ratio, jump, taken = np.array(values).T
        together.append(
            (
                name,
                f"{np.count_nonzero(ratio <= MOST_RATIO)} of {len(ratio)}",
                f"{ratio.max():.1f}",
                f"{np.median(jump):.2%}",
                f"{jump.max():.1%}",
                f"{np.median(taken):.0f}",
            )
        )
    header = (
        "measure",
        f"motions of ratio <= {MOST_RATIO:g}",
        "largest ratio",
        "jump, median",
        "largest",
        "ms a mesh",
    )
    return [each, Table(f"All {len(next(iter(summary.values())))} motions", header, together)]


def turned(rng: np.random.Generator) -> np.ndarray:
    """A random rotation."""
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q *= np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def invariance(settings: Settings, frames: Sequence[Frame], found: list[Candidate]) -> Table:
    """L1: four orientations of the same pose, and three sizes."""
    body, mocap = load_body(), load_mocap()
    rng = np.random.default_rng(settings.seed)
    names = [frame.name for frame in frames if frame.far][: settings.colliding]
    spread: dict[str, list[float]] = {candidate.name: [] for candidate in found}
    for name in names:
        pose = body.pose_from_smpl(mocap.pose[list(mocap.names).index(name)])
        vertices = np.asarray(body(pose).vertices, np.float64)
        meshes = np.stack([vertices, *(vertices @ turned(rng).T for _ in range(3))])
        for candidate in found:
            volumes = np.array(candidate.measure(meshes)[0])
            largest = volumes.max()
            spread[candidate.name].append(np.ptp(volumes) / largest if largest > 0 else 0.0)
    return Table(
        f"One pose in four orientations, {len(names)} colliding frames: spread of the volume",
        ("measure", "median", "largest", "target"),
        [
            (name, f"{np.median(values):.1e}", f"{max(values):.1e}", "1e-09")
            for name, values in spread.items()
        ],
    )


def gradients(settings: Settings, frames: Sequence[Frame]) -> Table:
    """L2 and L6: whether the volume is exact, and its slope against central differences."""
    body, mocap = load_body(), load_mocap()
    faces, rest = np.asarray(body.faces, np.int64), body.rest_surface
    rng = np.random.default_rng(settings.seed)
    names = [frame.name for frame in frames if frame.far][: settings.colliding]
    errors: dict[str, list[tuple[float, float]]] = {"pure": [], "mixed": []}
    exact = 0
    for name in names:
        pose = body.pose_from_smpl(mocap.pose[list(mocap.names).index(name)])
        vertices = np.asarray(body(pose).vertices, np.float64)
        pieces = pieces_of(vertices, faces, rest)
        exact += pieces.overlap.sound
        share = judged_of(pieces.overlap).share
        slope, held = pieces.overlap.gradient(), slope_with_shares_held(pieces)
        velocity = np.sin(vertices @ rng.normal(size=(3, 3)) * 5 + rng.normal(size=3))
        ends = [as_built(pieces_of(vertices + s * velocity, faces, rest)) for s in (1e-7, -1e-7)]
        true, size = (ends[0] - ends[1]) / 2e-7, np.abs(slope * velocity).sum()
        kind = "mixed" if ((share > 0) & (share < 1)).any() else "pure"
        errors[kind].append(tuple(abs(true - np.sum(g * velocity)) / size for g in (slope, held)))
    rows = [("measured without rays", f"{exact} of {len(names)}", "", "all")]
    for kind, target in (("pure", "1e-06"), ("mixed", "1e-03")):
        if errors[kind]:
            own, held = np.array(errors[kind]).T
            count = f"{len(own)} frames with {kind} regions"
            rows.append(
                (
                    f"error of the slope, {count}",
                    f"{np.median(own):.1e}",
                    f"{own.max():.1e}",
                    target,
                )
            )
            rows.append(
                ("the same with shares held", f"{np.median(held):.1e}", f"{held.max():.1e}", "")
            )
    return Table("The measure as built", ("what", "median", "largest", "target"), rows)


def laws(settings: Settings, frames: Sequence[Frame]) -> list[Table]:
    """L1, L2, L5 and L6 for the measure as built, and what it was compared with."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory()))
        earlier = None
        if settings.earlier:
            earlier = Worker(stack.enter_context(checked_out(settings.earlier)), _WORKER)
            stack.callback(earlier.close)
        found = candidates(earlier, folder)
        return [
            gradients(settings, frames),
            invariance(settings, frames, found),
            *continuity(settings, frames, found),
        ]


def main(settings: Settings) -> None:
    frames = measured(settings)
    parts = [*tables(frames), hand_table(), *laws(settings, frames)]
    for table in parts:
        table.print()
    if settings.record:
        command = (
            f"python -m benchmarks.folds --frames {settings.frames} --seed {settings.seed} --record"
        )
        about = (
            "Crossings are ipctk's, on all edges and triangles of the posed body; their distance "
            "is the shortest way along the edges of the rest mesh. The candidates are in "
            f"`fold_candidates.py`; the earlier tree is {settings.earlier}."
        )
        record_section(
            "folds",
            "Folds told from collisions",
            "\n\n".join([provenance(command), about, *(table.markdown() for table in parts)]),
        )


if __name__ == "__main__":
    main(tyro.cli(Settings))
