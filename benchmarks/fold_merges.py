"""Where the volume that counts jumps: `python -m benchmarks.fold_merges [--record]`.

`benchmarks.folds` walks straight ways in steps of half a millimetre. Here the largest step of the
roughest of them is cut into ten, the largest part of it again, and so on: what keeps its size is a
jump, what falls to a tenth is only steep. Regions of overlap are told by triangles, so two of them
that one triangle bounds are one, however far apart they are in it. So the same shapes are measured
with every triangle cut into four, too: that moves no surface and no contour.
"""

from dataclasses import dataclass

import numpy as np
import tyro
from jaxtyping import Float

from benchmarks.common import Table, progress, provenance, record_section
from benchmarks.fold_candidates import Pieces, as_built, by_field, judged_of, pieces_of
from benchmarks.folds import motion
from spt_jax import RestSurface, load_body

# The way on which (a) misses the law of ten median steps, as `benchmarks.folds` records it.
START, END, STEPS = "getup_facedown/0125", "roll/0100", 200


_NOTE = """
What keeps its size where the step is cut is a jump. The regions tell why: their contours and
volumes add up to the same on both sides of it, so nothing meets there. One triangle bounds two
overlaps that are apart in it, and regions are told by triangles, so they count with one share until
the triangle leaves one of them. Cut into four, triangles are small enough to tell them apart.
Shares by pieces of triangles would mend it for any mesh; `closed_form.shares_of` adds pieces up by
triangle, and that was not changed.
"""


@dataclass
class Settings:
    """How far the step is cut."""

    depth: int = 3
    """So many times into ten parts."""
    record: bool = False
    """Write the tables into results.md."""


class Fine:
    """(a) of the same surface with every triangle cut into four at its edges' middles."""

    def __init__(self):
        body = load_body()
        faces = np.asarray(body.faces, np.int64)
        sides = np.sort(faces[:, [[1, 2], [2, 0], [0, 1]]].reshape(-1, 2), axis=1)
        self._edges, middle = np.unique(sides, axis=0, return_inverse=True)
        m = middle.reshape(-1, 3) + len(body.template)
        x, y, z = faces.T
        cut = [(x, m[:, 2], m[:, 1]), (m[:, 2], y, m[:, 0]), (m[:, 1], m[:, 0], z), m.T]
        self.faces = np.stack([np.stack(corners, axis=1) for corners in cut], axis=1).reshape(-1, 3)
        distances = np.repeat(body.rest_surface.distances, 4)
        template = np.asarray(body.template, np.float64)
        self.rest = RestSurface(self.vertices(template), self.faces, distances)

    def vertices(self, coarse: Float[np.ndarray, "V 3"]) -> Float[np.ndarray, "W 3"]:
        """The vertices, and then the middles of the edges."""
        return np.concatenate([coarse, coarse[self._edges].mean(axis=1)])

    def pieces(self, coarse: Float[np.ndarray, "V 3"]) -> Pieces:
        """What intersects."""
        return pieces_of(self.vertices(coarse), self.faces, self.rest)


def regions_table(name: str, sides: dict[str, Pieces]) -> Table:
    """The regions of overlap on both sides of a jump, the largest first."""
    rows = []
    for side, pieces in sides.items():
        judged = judged_of(pieces.overlap)
        length = judged.length / pieces.overlap.surface.scale
        for k in np.argsort(-pieces.volume):
            volume = f"{1e6 * pieces.volume[k]:.1f}"
            rows.append((side, volume, f"{100 * length[k]:.1f}", f"{judged.share[k]:.3f}"))
    header = ("", "volume, cm^3", "contour, cm", "share that counts")
    return Table(f"Regions on both sides of it, {name}", header, rows)


def main(settings: Settings) -> None:
    body, fine = load_body(), Fine()
    faces, rest = np.asarray(body.faces, np.int64), body.rest_surface
    meshes = motion(START, END, STEPS)
    names = (
        "the whole overlap",
        "(a) as built: share of the contour that is far",
        "(b) field of all contours, sampled",
        "(a), every triangle cut into four",
    )

    def at(vertices):
        pieces = pieces_of(vertices, faces, rest)
        return np.array([float(pieces.volume.sum()), as_built(pieces), by_field(pieces, True)])

    def cut(vertices):
        return np.append(at(vertices), as_built(fine.pieces(vertices)))

    def changes(values):
        return 1e6 * np.abs(np.diff(values, axis=0))

    with progress() as bar:
        steps = changes([at(vertices) for vertices in bar.track(meshes, description="walking")])
    worst = int(steps[:, 1].argmax())
    low, high = meshes[worst], meshes[worst + 1]
    first = last = changes([cut(low), cut(high)])[0]
    for _ in range(settings.depth):
        between = [low + t * (high - low) for t in np.linspace(0, 1, 11)]
        place = int(changes([at(vertices) for vertices in between])[:, 1].argmax())
        low, high = between[place], between[place + 1]
        last = changes([cut(low), cut(high)])[0]
    median, most = np.median(steps, axis=0), steps.max(axis=0)
    walked = [(f"{m:.3g}", f"{x:.3g}", f"{x / m:.1f}") for m, x in zip(median, most, strict=True)]
    rows = [
        (name, *of_walk, f"{step:.3g}", f"{part:.3g}")
        for name, of_walk, step, part in zip(
            names, [*walked, ("", "", "")], first, last, strict=True
        )
    ]
    within = f"the worst {0.5 * 10.0**-settings.depth:g} mm of it"
    header = ("measure", "median step", "largest", "ratio", f"step {worst + 1}", within)
    title = f"{START} to {END}, {STEPS} steps of 0.5 mm: changes of the volume, cm^3"
    sides = {"before": low, "after": high}
    tables = [
        Table(title, header, rows),
        regions_table("as built", {k: pieces_of(v, faces, rest) for k, v in sides.items()}),
        regions_table("triangles cut", {k: fine.pieces(v) for k, v in sides.items()}),
    ]
    for table in tables:
        table.print()
    if settings.record:
        parts = [provenance("python -m benchmarks.fold_merges --record"), _NOTE.strip()]
        parts += [table.markdown() for table in tables]
        record_section("fold-merges", "Where regions of overlap merge", "\n\n".join(parts))


if __name__ == "__main__":
    main(tyro.cli(Settings, description=__doc__))
