"""How well and how fast `rays="auto"` measures real bodies: `python -m benchmarks.auto_rays`.

The reference is a beam of 4096 x 4096 rays in each of three directions, some 10 s a frame; it is
kept in a cache file, so that only the first run waits for it.
"""

import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import tyro
from jaxtyping import Float, Int

from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.oracles import crossing_pairs, edges_of
from spt_jax import load_body, load_mocap
from spt_jax.arguments import as_directions
from spt_jax.output_files import atomic_write
from spt_jax.rays import measure

REFERENCE_RAYS = 4096
PLAIN_RAYS = 512  # whose cost is the unit
VOLUME_WITHIN, VOLUME_FLOOR, GRADIENT_WITHIN = 5e-3, 1e-9, 2e-2
POSE_DIRECTIONS = 20
REPEATS = 3

Rays = int | Literal["auto"]


@dataclass
class Settings:
    """Which frames are measured, and what is compared with the reference."""

    frames: int = 100
    seed: int = 0
    rays: tuple[Rays, ...] = ("auto",)
    cache: Path = Path(tempfile.gettempdir()) / "spt_jax_reference_4096.npz"
    """Where references are kept between runs, by frame name; remove it when the rays change."""
    record: bool = False
    """Write the tables into results.md."""


def sampling(rays: Rays) -> measure.Sampling:
    """So many rays in each of three directions."""
    return measure.Sampling(rays, as_directions(3))


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


class Reference(NamedTuple):
    """What 4096 x 4096 rays find: a volume for each direction, and the boundary gradient."""

    volumes: Float[np.ndarray, "3"]
    gradient: Float[np.ndarray, "V 3"]


class References:
    """References by frame name, kept in an .npz file."""

    def __init__(self, file: Path) -> None:
        self.file = file
        self._found: dict[str, np.ndarray] = {}
        if file.exists():
            with np.load(file, allow_pickle=False) as stored:
                self._found = {key: stored[key] for key in stored.files}

    def has(self, name: str) -> bool:
        """Whether the frame needs no computing."""
        return f"{name} volumes" in self._found

    def of(
        self,
        name: str,
        vertices: Float[np.ndarray, "V 3"],
        faces: Int[np.ndarray, "F 3"],
    ) -> Reference:
        """The frame's reference, from the file or computed and added to it."""
        if not self.has(name):
            found = measure.measure(vertices, faces, sampling(REFERENCE_RAYS))
            gradient = found.gradient("boundary", "vertex")
            self._found[f"{name} volumes"] = np.array([beam.volume for beam in found.beams])
            # float32 halves a file of 30 MB and is 1e-7 off, where 2e-2 is to be told.
            self._found[f"{name} gradient"] = gradient.astype(np.float32)
            with atomic_write(self.file) as temporary, temporary.open("wb") as file:
                np.savez(file, allow_pickle=False, **self._found)
        return Reference(
            self._found[f"{name} volumes"], self._found[f"{name} gradient"].astype(np.float64)
        )


class Figures(NamedTuple):
    """One frame against its reference, and against plain rays; times in units of plain rays'."""

    volume: float
    error: float
    gradient: float
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


def compared(bodies: Bodies, frame: int, rays: Rays, reference: Reference, seed: int) -> Figures:
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
    expected = np.einsum("kvi,vi->k", velocities, reference.gradient)
    off = np.einsum("kvi,vi->k", velocities, gradient - reference.gradient)
    error = float(np.linalg.norm(off) / max(np.linalg.norm(expected), np.finfo(float).tiny))
    volume_error = volume - reference.volumes.mean()
    return Figures(volume, volume_error, error, cost, cost_with_gradient, fastest[0, 1])


def tables(
    rays: Rays, figures: list[Figures], references: Float[np.ndarray, "N"], names: list[str]
) -> list[Table]:
    """The spread of the errors and costs, and the frames that fall short."""
    volume, error, gradient, cost, cost_both, seconds = np.array(figures).T
    relative = np.abs(error) / np.maximum(references, np.finfo(float).tiny)
    good = (relative <= VOLUME_WITHIN) | (np.abs(error) <= VOLUME_FLOOR)
    steep = gradient <= GRADIENT_WITHIN
    within = (
        f"{good.sum()} of {len(good)} (or within {VOLUME_FLOOR:g} m^3)",
        "",
        f"{steep.sum()} of {len(steep)}",
        "",
        f"{np.sum(cost_both <= 1)} of {len(cost_both)}",
        "",
    )
    lines = (
        (f"volume error, % (target {VOLUME_WITHIN:.1%})", 100 * relative),
        ("volume error, m^3", np.abs(error)),
        (f"gradient error, % (target {GRADIENT_WITHIN:.0%})", 100 * gradient),
        (f"cost of the volume against {PLAIN_RAYS} x {PLAIN_RAYS}", cost),
        ("cost of volume and gradient against the same (target 1)", cost_both),
        ("milliseconds for both", 1e3 * seconds),
    )
    spread = Table(
        f'rays="{rays}"' if rays == "auto" else f"rays={rays}",
        ("figure", "median", "90 %", "maximum", "frames within the target"),
        [
            (name, *(f"{x:.3g}" for x in np.percentile(values, [50, 90, 100])), target)
            for (name, values), target in zip(lines, within, strict=True)
        ],
    )
    short = sorted(np.flatnonzero(~good | ~steep), key=lambda k: -relative[k])
    exceptions = Table(
        f"Frames that fall short with rays={rays}",
        ("frame", "reference, m^3", "volume, m^3", "volume error, %", "gradient error, %", "cost"),
        [
            (
                names[k],
                f"{references[k]:.4g}",
                f"{volume[k]:.4g}",
                f"{100 * relative[k]:.3g}",
                f"{100 * gradient[k]:.3g}",
                f"{cost_both[k]:.2f}",
            )
            for k in short
        ],
    )
    return [spread, exceptions]


def main(settings: Settings) -> None:
    bodies = Bodies()
    frames = overlapping_frames(bodies, settings.frames, settings.seed)
    names = [bodies.mocap.names[frame] for frame in frames]
    store = References(settings.cache)
    references = []
    with progress() as bar:
        for frame, name in zip(bar.track(frames, description="reference"), names, strict=True):
            if not store.has(name):
                print(f"reference of {name}, {len(references) + 1} of {len(frames)}", flush=True)
            references.append(store.of(name, bodies.vertices(frame), bodies.faces))
    volumes = np.array([found.volumes.mean() for found in references])
    apart = [np.ptp(found.volumes) / max(found.volumes.mean(), 1e-300) for found in references]
    about = (
        f"{len(frames)} mocap frames that cross themselves, of every motion; reference: the mean "
        f"of three directions at {REFERENCE_RAYS} x {REFERENCE_RAYS} rays, whose own three volumes "
        f"differ by {100 * np.median(apart):.2g} % in the median and {100 * np.max(apart):.2g} % "
        f"at most. The gradient is projected on {POSE_DIRECTIONS} random pose directions; its "
        "error is the norm of the difference over the norm of the reference. A cost is the ratio "
        f"to the plain beams' time in the same process, the least of {REPEATS} alternating runs "
        "of each."
    )
    print(about)
    parts = []
    for rays in settings.rays:
        figures = []
        with progress() as bar:
            pairs = zip(frames, references, strict=True)
            for frame, reference in bar.track(pairs, total=len(frames), description=str(rays)):
                figures.append(compared(bodies, frame, rays, reference, settings.seed))
        for table in tables(rays, figures, volumes, names):
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
