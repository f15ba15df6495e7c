"""How well and how fast `rays="auto"` measures real bodies: `python -m benchmarks.auto_rays`.

Two references: 4096 x 4096 rays in each of three directions, some 10 s a frame, and the exact
overlap of the triangles (`references.py`), which tells how far off those rays are themselves. Both
are kept in cache files, so that only the first run waits for them.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float, Int

from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.oracles import crossing_pairs, edges_of
from benchmarks.references import REFERENCE_RAYS, Kept, Rays, Reference, by_rays, exact, sampling
from spt_jax import load_body, load_mocap
from spt_jax.overlap import measure

PLAIN_RAYS = 512  # whose cost is the unit
VOLUME_WITHIN, VOLUME_FLOOR, GRADIENT_WITHIN = 5e-3, 1e-9, 2e-2
POSE_DIRECTIONS = 20
REPEATS = 3


@dataclass
class Settings:
    """Which frames are measured, and what is compared with the reference."""

    frames: int = 100
    seed: int = 0
    rays: tuple[Rays, ...] = ("auto",)
    cache: Path = Path(tempfile.gettempdir()) / "spt_jax_reference_4096.npz"
    """Where references are kept between runs, by frame name; the exact ones lie beside it, under
    the same name with _exact. Remove both when the body or its poses change."""
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


def overlapping_frames(bodies: Bodies, count: int, seed: int) -> list[int]:
    """Frames whose surface crosses itself, taken from the motions in turn, shuffled within each.

    Edge-triangle crossings decide, not rays: an overlap that coarse rays miss stays in.
    """
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


class Figures(NamedTuple):
    """One frame against its reference, and against plain rays; times in units of plain rays'."""

    volume: float
    error: float
    gradient: float
    exact_error: float
    exact_gradient: float
    cost: float
    cost_with_gradient: float
    seconds: float


def measured(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], rays: Rays
) -> tuple[float, Float[np.ndarray, "V 3"], Float[np.ndarray, "2"]]:
    """Volume and gradient, with the seconds that the volume and that both took."""
    start = time.perf_counter()
    found = measure.measure(vertices, faces, sampling(rays))
    volume = found.volume
    halfway = time.perf_counter()
    gradient = found.gradient("boundary", "vertex")
    return volume, gradient, np.array([halfway - start, time.perf_counter() - start])


def gradient_error(
    velocities: Float[np.ndarray, "K V 3"],
    gradient: Float[np.ndarray, "V 3"],
    reference: Float[np.ndarray, "V 3"],
) -> float:
    """Of the derivatives in the pose directions: |difference| / |reference|."""
    expected = np.einsum("kvi,vi->k", velocities, reference)
    off = np.einsum("kvi,vi->k", velocities, gradient - reference)
    return float(np.linalg.norm(off) / max(np.linalg.norm(expected), np.finfo(float).tiny))


def compared(
    bodies: Bodies, frame: int, rays: Rays, reference: Reference, truth: Reference, seed: int
) -> Figures:
    """One frame with the rays in question, timed in turns with plain rays."""
    vertices, velocities = bodies.vertices(frame), bodies.velocities(frame, seed)
    volume, gradient, _ = measured(vertices, bodies.faces, rays)  # also warms the caches
    seconds = np.array(
        [
            [measured(vertices, bodies.faces, each)[2] for each in (rays, PLAIN_RAYS)]
            for _ in range(REPEATS)
        ]
    )
    # The least of the repeats: other programs can only make one longer.
    fastest = seconds.min(axis=0)
    cost, cost_with_gradient = fastest[0] / fastest[1]
    return Figures(
        volume,
        volume - reference.volume,
        gradient_error(velocities, gradient, reference.gradient),
        volume - truth.volume,
        gradient_error(velocities, gradient, truth.gradient),
        cost,
        cost_with_gradient,
        fastest[0, 1],
    )


def tables(
    rays: Rays,
    figures: list[Figures],
    references: list[Reference],
    truths: list[Reference],
    names: list[str],
) -> list[Table]:
    """The spread of the errors and costs, and the frames that fall short."""
    volume, error, gradient, exact_error, exact_gradient, volume_cost, cost, seconds = np.array(
        figures
    ).T
    sizes = np.array([reference.volume for reference in references])
    relative = relative_to(error, sizes)
    exactly = relative_to(exact_error, np.array([truth.volume for truth in truths]))
    good, exactly_good = (
        (part <= VOLUME_WITHIN) | (np.abs(off) <= VOLUME_FLOOR)
        for part, off in ((relative, error), (exactly, exact_error))
    )
    steep = gradient <= GRADIENT_WITHIN
    volume_target = f"{VOLUME_WITHIN:.1%} or {VOLUME_FLOOR:g} m^3"
    lines = (
        ("volume error, %", 100 * relative, volume_target, good),
        ("volume error, m^3", np.abs(error), "", None),
        ("gradient error, %", 100 * gradient, f"{GRADIENT_WITHIN:.0%}", steep),
        ("volume error against the exact one, %", 100 * exactly, volume_target, exactly_good),
        (
            "gradient error against the exact one, %",
            100 * exact_gradient,
            f"{GRADIENT_WITHIN:.0%}",
            exact_gradient <= GRADIENT_WITHIN,
        ),
        (f"cost of the volume, {PLAIN_RAYS} x {PLAIN_RAYS} being 1", volume_cost, "", None),
        ("cost of volume and gradient, likewise", cost, "median 1", cost <= 1),
        ("milliseconds for both", 1e3 * seconds, "", None),
    )
    spread = Table(
        f'rays="{rays}"' if rays == "auto" else f"rays={rays}",
        ("figure", "median", "90 %", "maximum", "target", "frames within"),
        [
            (
                name,
                *(f"{x:.3g}" for x in np.percentile(values, [50, 90, 100])),
                target,
                "" if within is None else f"{within.sum()} of {len(within)}",
            )
            for name, values, target, within in lines
        ],
    )
    short = sorted(np.flatnonzero(~good | ~steep), key=lambda k: -relative[k])
    exceptions = Table(
        f"Frames that fall short with rays={rays}",
        (
            "frame",
            "reference, m^3",
            "volume, m^3",
            "volume error, %",
            "gradient error, %",
            "against the exact one, %",
            "cost",
        ),
        [
            (
                names[k],
                f"{sizes[k]:.4g}",
                f"{volume[k]:.4g}",
                f"{100 * relative[k]:.3g}",
                f"{100 * gradient[k]:.3g}",
                f"{100 * exact_gradient[k]:.3g}",
                f"{cost[k]:.2f}",
            )
            for k in short
        ],
    )
    return [spread, exceptions] if len(short) else [spread]


def relative_to(error: Float[np.ndarray, "N"], size: Float[np.ndarray, "N"]):
    """|error| / size."""
    return np.abs(error) / np.maximum(size, np.finfo(float).tiny)


def introduction(
    bodies: Bodies,
    frames: list[int],
    references: list[Reference],
    truths: list[Reference],
    settings: Settings,
) -> str:
    """What was measured, and how good the reference is itself."""
    off = [
        gradient_error(bodies.velocities(frame, settings.seed), coarse.gradient, fine.gradient)
        for frame, coarse, fine in zip(frames, references, truths, strict=True)
    ]
    volume_off = [
        abs(coarse.volume / fine.volume - 1)
        for coarse, fine in zip(references, truths, strict=True)
    ]
    return (
        f"{len(frames)} mocap frames that cross themselves, of every motion. Reference: the mean "
        f"of three directions at {REFERENCE_RAYS} x {REFERENCE_RAYS} rays; its volume is "
        f"{100 * np.median(volume_off):.2g} % off the exact one in the median and "
        f"{100 * np.max(volume_off):.2g} % at most, its gradient {100 * np.median(off):.2g} % and "
        f"{100 * np.max(off):.2g} %. Gradients are projected on {POSE_DIRECTIONS} random pose "
        "directions; the error is the norm of the difference over the norm of the reference. A "
        f"cost is the ratio to the plain beams' time in the same process, the least of {REPEATS} "
        "alternating runs of each."
    )


def main(settings: Settings) -> None:
    bodies = Bodies()
    frames = overlapping_frames(bodies, settings.frames, settings.seed)
    names = [bodies.mocap.names[frame] for frame in frames]
    truths_file = settings.cache.with_stem(settings.cache.stem + "_exact")
    kept = {"exact": Kept(truths_file, exact), "rays": Kept(settings.cache, by_rays)}
    found: dict[str, list[Reference]] = {}
    with progress() as bar:
        for title, store in kept.items():
            task = bar.add_task(title, total=len(frames))
            found[title] = []
            for frame, name in zip(frames, names, strict=True):
                if not store.has(name):
                    print(f"{title}: {name}, {len(found[title]) + 1} of {len(frames)}", flush=True)
                found[title].append(store.of(name, bodies.vertices(frame), bodies.faces))
                bar.advance(task)
    references, truths = found["rays"], found["exact"]
    about = introduction(bodies, frames, references, truths, settings)
    print(about)
    parts = []
    for rays in settings.rays:
        figures = []
        with progress() as bar:
            for k in bar.track(range(len(frames)), description=str(rays)):
                figures.append(
                    compared(bodies, frames[k], rays, references[k], truths[k], settings.seed)
                )
        for table in tables(rays, figures, references, truths, names):
            table.print()
            parts.append(table.markdown())
    if settings.record:
        asked = " ".join(map(str, settings.rays))
        command = (
            f"python -m benchmarks.auto_rays --frames {settings.frames} --seed {settings.seed} "
            f"--rays {asked} --record"
        )
        record_section(
            "auto-rays",
            "Rays by themselves, against 4096 x 4096",
            "\n\n".join([provenance(command), about, *parts]),
        )


if __name__ == "__main__":
    main(tyro.cli(Settings))
