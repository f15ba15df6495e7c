"""Whether folds are told from collisions: `python -m benchmarks.folds`.

The oracle looks at triangles alone (`oracles.py`): a frame collides where an edge crosses a
triangle that is farther than 0.3 m along the rest surface. There the volume without folds should
be positive; elsewhere it should be nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import jax
import numpy as np
import tyro

from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.oracles import FAR, RestGraph, far_crossings
from spt_jax import load_body, load_mocap, self_intersection_penalty

NOTHING = 1e-8  # m^3
LEAST_SEEN, LEAST_SILENT = 0.98, 0.95


@dataclass
class Settings:
    """Which frames are measured."""

    frames: int = 300
    """Up to 1,086, which is all of them."""
    seed: int = 0
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
        collision = self_intersection_penalty(vertices, body.faces, folds=body.rest_surface)
        return vertices, collision, self_intersection_penalty(vertices, body.faces)

    return jax.jit(both)


def measured(settings: Settings) -> list[Frame]:
    """The frames of a seeded shuffle, each with its crossings and volumes."""
    body, mocap = load_body(), load_mocap()
    faces = np.asarray(body.faces, np.int64)
    graph = RestGraph.of(np.asarray(body.template, np.float64), faces)
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
                f"a crossing is farther than {FAR:g} m",
                "positive",
                share([frame for frame in colliding if frame.collision > 0], colliding),
                f"{LEAST_SEEN:.0%}",
            ),
            (
                "no crossing is",
                f"at most {NOTHING:g} m^3",
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
        found.append(exceptions(f"No far crossing, but more than {NOTHING:g} m^3", loud))
    return found


def main(settings: Settings) -> None:
    parts = tables(measured(settings))
    for table in parts:
        table.print()
    if settings.record:
        command = (
            f"python -m benchmarks.folds --frames {settings.frames} --seed {settings.seed} --record"
        )
        about = (
            "Crossings are ipctk's, on all edges and triangles of the posed body; their distance "
            "is the shortest way along the edges of the rest mesh. Volumes at the default rays."
        )
        record_section(
            "folds",
            "Folds told from collisions",
            "\n\n".join([provenance(command), about, *(table.markdown() for table in parts)]),
        )


if __name__ == "__main__":
    main(tyro.cli(Settings))
