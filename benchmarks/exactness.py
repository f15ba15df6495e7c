"""How exact the overlap volume and its gradient are: `python -m benchmarks.exactness`.

Three kinds of surface. Bodies of the motion capture, against CGAL's cuts (`references.py`), beside
what rays give. Solids at random, three and four in one place, against exact booleans summed over
pairs. And contact: solids that touch, coincide or have sides of many triangles, turned at random,
where the right value is known.
"""

import itertools
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import jax
import jax.numpy as jnp
import manifold3d
import numpy as np
import trimesh
import tyro
from jaxtyping import Float, Int

from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.oracles import crossing_pairs, edges_of
from benchmarks.references import Reference, exact
from spt_jax import load_body, load_mocap
from spt_jax._query import as_directions
from spt_jax.overlap.measure import Measurement, Sampling, measure

POSE_DIRECTIONS = 20
RAYS = 512
Mesh = tuple[Float[np.ndarray, "V 3"], Int[np.ndarray, "F 3"]]


@dataclass
class Settings:
    """How much of each kind is measured."""

    frames: int = 60
    """Frames that intersect, against exact arithmetic: some 3 s each."""
    cast: int = 300
    """Frames of which only is asked whether a ray is cast."""
    solids: int = 300
    """Random triples and quadruples of solids."""
    turns: int = 1000
    """How often each flat-sided solid is turned."""
    seed: int = 0
    record: bool = False
    """Write the tables into results.md."""


class Bodies:
    """The embedded body in the frames of its motion capture, as float64."""

    def __init__(self) -> None:
        self.body, self.mocap = load_body(), load_mocap()
        self.faces = np.asarray(self.body.faces, np.int64)
        self._posed = jax.jit(lambda pose: self.body(pose).vertices)
        self._moved = jax.jit(
            jax.vmap(
                lambda pose, along: jax.jvp(lambda p: self.body(p).vertices, (pose,), (along,))[1],
                in_axes=(None, 0),
            )
        )

    def vertices(self, frame: int) -> Float[np.ndarray, "V 3"]:
        """The body's vertices in one frame."""
        return np.asarray(self._posed(self._pose(frame)), np.float64)

    def velocities(self, frame: int, seed: int) -> Float[np.ndarray, "K V 3"]:
        """How the vertices move in POSE_DIRECTIONS random unit directions of the SMPL pose."""
        along = np.random.default_rng(seed).normal(
            size=(POSE_DIRECTIONS, *self.mocap.pose.shape[1:])
        )
        along /= np.linalg.norm(along, axis=(1, 2), keepdims=True)
        along = self.body.pose_from_smpl(along.astype(np.float32))
        return np.asarray(self._moved(self._pose(frame), along), np.float64)

    def _pose(self, frame: int):
        return self.body.pose_from_smpl(jnp.asarray(self.mocap.pose[frame]))


def intersecting_frames(bodies: Bodies, count: int, seed: int) -> list[int]:
    """Frames whose surface meets itself, by ipctk, taken from the motions in turn."""
    edges = edges_of(bodies.faces)
    motions: dict[str, list[int]] = {}
    for frame in np.random.default_rng(seed).permutation(len(bodies.mocap.names)):
        motions.setdefault(bodies.mocap.names[frame].split("/")[0], []).append(int(frame))
    chosen: list[int] = []
    while len(chosen) < count and any(motions.values()):
        for name in sorted(motions):
            while motions[name]:
                frame = motions[name].pop()
                if len(crossing_pairs(bodies.vertices(frame), bodies.faces, edges)):
                    chosen.append(frame)
                    break
    return chosen[:count]


def exactly(mesh: Mesh) -> Measurement:
    """The measurement that is the default."""
    return measure(*mesh, Sampling(None, as_directions(3)))


def gradient_error(
    velocities: Float[np.ndarray, "K V 3"],
    gradient: Float[np.ndarray, "V 3"],
    reference: Float[np.ndarray, "V 3"],
) -> float:
    """Of the derivatives in the pose directions: |difference| / |reference|."""
    expected = np.einsum("kvi,vi->k", velocities, reference)
    off = np.einsum("kvi,vi->k", velocities, gradient - reference)
    return float(np.linalg.norm(off) / max(np.linalg.norm(expected), np.finfo(float).tiny))


def bodies_table(settings: Settings, bar) -> list[Table]:
    """Bodies against exact arithmetic, and how many of them cast a ray."""
    bodies = Bodies()
    frames = intersecting_frames(bodies, settings.frames, settings.seed)
    errors: dict[str, list[tuple[float, float]]] = {"default": [], f"rays={RAYS}": []}
    for frame in bar.track(frames, description="bodies"):
        vertices, velocities = bodies.vertices(frame), bodies.velocities(frame, settings.seed)
        truth: Reference = exact(vertices, bodies.faces)
        for name, rays in (("default", None), (f"rays={RAYS}", RAYS)):
            found = measure(vertices, bodies.faces, Sampling(rays, as_directions(3)))
            volume = abs(found.volume - truth.volume) / truth.volume
            pull = found.gradient("boundary", "vertex")
            errors[name].append((volume, gradient_error(velocities, pull, truth.gradient)))
    rows = []
    for name, values in errors.items():
        for what, column in zip(("volume", "gradient"), np.array(values).T, strict=True):
            spread = (f"{100 * x:.2g}" for x in np.percentile(column, [50, 90, 100]))
            rows.append((f"{name}: error of the {what}, %", *spread))
    title = f"{len(frames)} frames that intersect, against CGAL's cuts"
    chosen = np.random.default_rng(settings.seed).permutation(len(bodies.mocap.names))
    cast = 0
    for frame in bar.track(chosen[: settings.cast], description="rays cast"):
        cast += not exactly((bodies.vertices(int(frame)), bodies.faces)).exact
    return [
        Table(title, ("figure", "median", "90 %", "maximum"), rows),
        Table("Rays", ("of", "cast any"), [(f"{settings.cast} frames", str(cast))]),
    ]


class Solid(NamedTuple):
    """A kind of solid to overlap with others."""

    name: str
    make: Callable[[np.random.Generator], trimesh.Trimesh]


def _star(rng: np.random.Generator) -> trimesh.Trimesh:
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.7)
    ball.vertices *= rng.uniform(0.4, 1.2, (len(ball.vertices), 1))
    return ball


def _ring(rng: np.random.Generator) -> trimesh.Trimesh:
    return trimesh.creation.torus(
        rng.uniform(0.5, 0.7), rng.uniform(0.1, 0.3), major_sections=24, minor_sections=10
    )


SOLIDS = (
    Solid("ball", lambda rng: trimesh.creation.icosphere(subdivisions=2, radius=0.6)),
    Solid("star", _star),
    Solid("ring", _ring),
    Solid("can", lambda rng: trimesh.creation.cylinder(0.4, 1.2, sections=16)),
    Solid("box", lambda rng: trimesh.creation.box(rng.uniform(0.3, 1.5, 3))),
)


def _turn(rng: np.random.Generator) -> Float[np.ndarray, "3 3"]:
    q, r = np.linalg.qr(rng.normal(size=(3, 3)))
    q = q * np.sign(np.diag(r))
    return q if np.linalg.det(q) > 0 else -q


def _mesh(solid: trimesh.Trimesh) -> Mesh:
    return np.array(solid.vertices, np.float64), np.array(solid.faces, np.int64)


def _joined(meshes: list[Mesh]) -> Mesh:
    start = np.cumsum([0, *(len(vertices) for vertices, _ in meshes)])
    faces = [f + k for (_, f), k in zip(meshes, start, strict=False)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def _boolean(first: Mesh, second: Mesh) -> float:
    one, other = (
        manifold3d.Manifold(manifold3d.Mesh64(vert_properties=v, tri_verts=f.astype(np.uint64)))
        for v, f in (first, second)
    )
    return (one ^ other).volume()


def solids_table(settings: Settings, bar) -> Table:
    """Triples and quadruples of solids against booleans, summed over pairs."""
    off, slopes, cast = [], [], 0
    for seed in bar.track(range(settings.solids), description="solids"):
        rng = np.random.default_rng([settings.seed, seed])
        meshes = []
        for _ in range(3 + seed % 2):
            vertices, faces = _mesh(SOLIDS[rng.integers(len(SOLIDS))].make(rng))
            meshes.append((vertices @ _turn(rng).T + rng.uniform(-0.3, 0.3, 3), faces))
        expected = sum(_boolean(a, b) for a, b in itertools.combinations(meshes, 2))
        mesh = _joined(meshes)
        found = exactly(mesh)
        cast += not found.exact
        off.append(abs(found.volume - expected) / expected)
        motion, step = rng.normal(size=mesh[0].shape), 1e-6
        ends = [exactly((mesh[0] + s * step * motion, mesh[1])).volume for s in (1, -1)]
        pull = found.gradient("boundary", "vertex") * motion
        numeric = (ends[0] - ends[1]) / (2 * step)
        slopes.append(abs(pull.sum() - numeric) / np.abs(pull).sum())
    rows = [
        (name, *(f"{x:.2g}" for x in np.percentile(values, [50, 90, 100])))
        for name, values in (
            ("volume, relative", off),
            ("gradient against central differences, relative", slopes),
        )
    ]
    rows.append(("that cast a ray", str(cast), "", ""))
    title = f"{settings.solids} triples and quadruples of solids, against manifold3d by pairs"
    return Table(title, ("figure", "median", "90 %", "maximum"), rows)


def contact_table(settings: Settings, bar) -> Table:
    """Flat sides turned at random: what intersects, which is nothing."""
    box = trimesh.creation.box()
    kinds = {
        "box of 48 triangles": box.subdivide(),
        "of 192": box.subdivide().subdivide(),
        "of 768": box.subdivide().subdivide().subdivide(),
        "annulus": trimesh.creation.annulus(0.5, 1.0, 0.3, sections=16),
        "two boxes, side on side": trimesh.util.concatenate(
            box, box.copy().apply_translation([1.0, 0.2, 0.1])
        ),
        "can on a plate": trimesh.util.concatenate(
            trimesh.creation.box([3, 3, 1]),
            trimesh.creation.cylinder(0.4, 1.0, sections=16).apply_translation([0.1, 0.2, 1.0]),
        ),
    }
    rows = []
    for name, solid in kinds.items():
        vertices, faces = _mesh(solid)
        rng = np.random.default_rng(settings.seed)
        wrong, seconds = 0, []
        for _ in bar.track(range(settings.turns), description=name):
            placed = vertices @ _turn(rng).T + rng.normal(size=3)
            start = time.perf_counter()
            found = exactly((placed, faces))
            bad = (
                found.volume != 0 or found.total_intersecting_pairs or found.labels("vertex").any()
            )
            seconds.append(time.perf_counter() - start)
            wrong += bool(bad)
        rows.append((name, f"{wrong} of {settings.turns}", f"{1e3 * np.median(seconds):.1f}"))
    return Table(
        "Solids without an overlap, turned at random",
        ("solid", "with a pair, a volume or a label", "ms"),
        rows,
    )


def cost_table() -> Table:
    """What contact costs beside nearly the same mesh without it."""

    def milliseconds(mesh: Mesh) -> float:
        seconds = []
        for k in range(15):
            vertices = mesh[0].copy()
            vertices[8:, 0] += 1e-4 * k
            start = time.perf_counter()
            exactly((vertices, mesh[1])).gradient("boundary", "vertex")
            seconds.append(time.perf_counter() - start)
        return 1e3 * float(np.median(seconds[3:]))

    box = _mesh(trimesh.creation.box())
    fine = _mesh(trimesh.creation.box().subdivide().subdivide().subdivide())
    ball = _mesh(trimesh.creation.icosphere(subdivisions=2))
    lattice = [(box[0] + p, box[1]) for p in itertools.product(range(10), repeat=3)]
    jitter = 0.001 * np.random.default_rng(0).normal(size=(1000, 3))
    loose = [(v * 0.999 + j, f) for (v, f), j in zip(lattice, jitter, strict=True)]
    meshes = {
        "two boxes, sides flush": _joined([box, (box[0] + [0.5, 0, 0], box[1])]),
        "the same, moved aside by 1 %": _joined([box, (box[0] + [0.5, 0.01, 0.02], box[1])]),
        "two of 768 triangles, sides flush": _joined([fine, (fine[0] + [0.5, 0, 0], fine[1])]),
        "the same, moved aside": _joined([fine, (fine[0] + [0.5, 0.011, 0.023], fine[1])]),
        "1,000 boxes, side on side": _joined(lattice),
        "the same, not quite": _joined(loose),
        "80 spheres of 320 triangles in one place": _joined([ball] * 80),
        "120 nested spheres": _joined([(ball[0] * (1 + 0.01 * k), ball[1]) for k in range(120)]),
    }
    rows = [(name, f"{milliseconds(mesh):.1f}") for name, mesh in meshes.items()]
    return Table("The cost of contact: volume and gradient", ("mesh", "ms"), rows)


def main(settings: Settings) -> None:
    with progress() as bar:
        parts = [
            *bodies_table(settings, bar),
            solids_table(settings, bar),
            contact_table(settings, bar),
            cost_table(),
        ]
    for table in parts:
        table.print()
    if settings.record:
        command = (
            f"python -m benchmarks.exactness --frames {settings.frames} --cast {settings.cast} "
            f"--solids {settings.solids} --turns {settings.turns} --seed {settings.seed} --record"
        )
        about = (
            f"Gradients of bodies are projected on {POSE_DIRECTIONS} random pose directions; the "
            "error is the norm of the difference over the norm of the reference."
        )
        record_section(
            "exactness",
            "Exactness",
            "\n\n".join([provenance(command), about, *(table.markdown() for table in parts)]),
        )


if __name__ == "__main__":
    main(tyro.cli(Settings))
