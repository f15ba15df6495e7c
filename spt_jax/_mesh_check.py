"""Whether a mesh is one that the penalty can judge: closed but for holes, rightly wound."""

from collections.abc import Iterable
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Array, Bool, Float, Int

from spt_jax._query import as_mesh
from spt_jax.overlap.caps import LARGEST, Hole, closed_surface, holes_in_words, holes_of
from spt_jax.overlap.topology import Edges, count_loops, distinct
from spt_jax.overlap.triangles.manifold import manifold_of


@dataclass(frozen=True)
class MeshCheck:
    """What is wrong with a mesh, counted; printing it says so in words.

    Degenerate faces and repeated copies of a face are counted and then left out of the rest.

    Attributes:
        num_vertices, num_faces: as given.
        nonfinite_vertices: vertices with NaN or infinity.
        out_of_range_faces: faces with an index that names no vertex.
        degenerate_faces: faces that list a vertex twice. They have no area and do no harm.
        duplicate_faces: faces that repeat an earlier one in the same sense.
        boundary_edges: edges of one face only.
        holes: loops of boundary edges; loops that touch at a vertex are one.
        largest_hole: the loop that is largest beside the part around it: its `edges`, `length` and
            `size`, the area of a disk with that perimeter against that of the part. Up to 0.75 a
            fan to the mean of its vertices closes it; no flat sheet has less than 1, a hemisphere
            0.5.
        open_sheets: connected parts with a loop that is too large to be closed.
        misoriented_edges: edges that both of their two faces run through in the same sense.
        nonmanifold_edges: edges of more than two faces.
        unbalanced_edges: those of them that are run through more often one way than the other.
        nonmanifold_vertices: vertices whose faces form more than one fan.
        components: parts connected through edges.
        inverted_components: parts, closed or closed by fans, of negative volume, not within the
            bounding box of an outward one.
        inward_components: closed parts of negative volume within such a box: cavities, if they
            lie inside that part.
        unreferenced_vertices: vertices of no face.
        euler_number: vertices of faces - edges + faces.

    Example:
        >>> import trimesh
        >>> from spt_jax import check_mesh
        >>> box = trimesh.creation.box()
        >>> found = check_mesh(box.vertices, box.faces[1:])  # a triangle is missing
        >>> found.holes, found.boundary_edges, found.ok  # it is closed by a fan
        (1, 3, True)
        >>> print(found.warnings[0])
        1 hole of 3 edges, 3.41 long, 16.9% of its part: closed by fans
    """

    num_vertices: int
    num_faces: int
    nonfinite_vertices: int = 0
    out_of_range_faces: int = 0
    degenerate_faces: int = 0
    duplicate_faces: int = 0
    boundary_edges: int = 0
    holes: int = 0
    largest_hole: Hole | None = None
    open_sheets: int = 0
    misoriented_edges: int = 0
    nonmanifold_edges: int = 0
    unbalanced_edges: int = 0
    nonmanifold_vertices: int = 0
    components: int = 0
    inverted_components: int = 0
    inward_components: int = 0
    unreferenced_vertices: int = 0
    euler_number: int = 0
    problems: tuple[str, ...] = field(init=False)
    """What makes the penalty meaningless, one sentence each, with what to do about it."""
    warnings: tuple[str, ...] = field(init=False)
    """What the penalty can live with, but what may not be meant."""

    def __post_init__(self):
        object.__setattr__(self, "problems", tuple(_problems(self)))
        object.__setattr__(self, "warnings", tuple(_warnings(self)))

    @property
    def ok(self) -> bool:
        """Whether the penalty means something on this mesh."""
        return not self.problems

    def raise_if_unfit(self) -> None:
        """Do nothing for a mesh that is `ok`.

        Raises:
            ValueError: there are problems; the message lists them.
        """
        if not self.ok:
            raise ValueError(
                "mesh must be closed but for holes, consistently wound and right side out: got "
                + "; ".join(self.problems)
            )

    def as_dict(self) -> dict[str, Any]:
        """All counts, problems and warnings, and whether the mesh is `ok`, as JSON types."""
        hole = self.largest_hole
        named = None if hole is None else {k: getattr(hole, k) for k in ("edges", "length", "size")}
        return {"ok": self.ok, **asdict(self), "largest_hole": named}

    def __str__(self) -> str:
        return "\n".join([self._headline(), *(f"  {mark} {text}" for mark, text in self._lines())])

    def __rich__(self):
        from rich.text import Text

        colors = {"problem": "red", "warning": "yellow"}
        text = Text(self._headline(), style="green" if self.ok else "red")
        for mark, line in self._lines():
            text.append(f"\n  {mark} ", style=colors[mark.rstrip(":")])
            text.append(line, style="default")
        return text

    def _headline(self) -> str:
        verdict = "fit for the penalty" if self.ok else "not fit for the penalty"
        return (
            f"mesh: {_count(self.num_vertices, 'vertex', 'vertices')}, "
            f"{_count(self.num_faces, 'face')}, {_count(self.components, 'component')}; {verdict}"
        )

    def _lines(self) -> Iterable[tuple[str, str]]:
        yield from (("problem:", line) for line in self.problems)
        yield from (("warning:", line) for line in self.warnings)


def check_mesh(
    vertices: Float[Array, "V 3"] | np.ndarray, faces: Int[Array, "F 3"] | np.ndarray
) -> MeshCheck:
    """What is wrong with a mesh, with counts and with what to do about it.

    The winding number of section 3.2 is defined where every edge is run through as often one way
    as the other: then each ray enters as often as it leaves. An edge of four faces can fulfil
    that, so it is a warning; an edge of one or of three cannot. A closed part that is inside out
    counts as self-intersection as a whole (w (w - 1) / 2 is 1 at w = -1), which is a fault of the
    mesh unless the part is the wall of a cavity.

    Args:
        vertices: positions of one mesh.
        faces: indices of each triangle's corners. Those out of range are counted, not refused.

    Returns:
        The counts, with `problems`, `warnings`, `ok` and `raise_if_unfit()`.

    Raises:
        TypeError: vertices not float32 or float64; faces not whole numbers.
        ValueError: shapes other than (V, 3) and (F, 3).

    Differentiation: none; for use outside jit.

    Example:
        >>> import numpy as np, trimesh
        >>> from spt_jax._mesh_check import check_mesh
        >>> box = trimesh.creation.box()
        >>> print(check_mesh(box.vertices, box.faces))
        mesh: 8 vertices, 12 faces, 1 component; fit for the penalty
        >>> print(check_mesh(box.vertices, box.faces[:4]).problems[0].split(":")[0])
        an open sheet
    """
    given, triangles = one_mesh(vertices, faces, counting=True)
    points = np.asarray(given, np.float64)
    finite = np.isfinite(points).all(axis=1)
    in_range = ((triangles >= 0) & (triangles < len(points))).all(axis=1)
    usable = triangles[in_range].astype(np.int64)
    degenerate = (usable == np.roll(usable, 1, axis=1)).any(axis=1)
    surface = distinct(usable[~degenerate])
    edges = Edges(surface)
    part = edges.components()
    closed = ~np.isin(part, part[edges.face[edges.imbalance[edges.edge] != 0]])
    holes = _holes(points, surface, edges, finite)
    sheets = {hole.part for hole in holes if not hole.is_closed}
    filled, whole, of_whole = points, surface, part
    if holes and not sheets:  # fans close all that is open
        filled, whole, beside = closed_surface(manifold_of(surface, len(points)), points, surface)
        of_whole, closed = part[beside], np.ones(len(whole), bool)
    inverted, inward = _inside_out(filled, whole, of_whole, closed)
    used = np.zeros(len(points), bool)
    used[usable] = True
    corners = np.unique(surface)
    return MeshCheck(
        num_vertices=len(points),
        num_faces=len(triangles),
        nonfinite_vertices=_total(~finite),
        out_of_range_faces=_total(~in_range),
        degenerate_faces=_total(degenerate),
        duplicate_faces=len(usable) - _total(degenerate) - len(surface),
        boundary_edges=_total(edges.faces == 1),
        holes=count_loops(edges.ends[edges.faces == 1]),
        largest_hole=max(holes, key=lambda hole: hole.size, default=None),
        open_sheets=len(sheets),
        misoriented_edges=_total((edges.faces == 2) & (edges.imbalance != 0)),
        nonmanifold_edges=_total(edges.faces > 2),
        unbalanced_edges=_total((edges.faces > 2) & (edges.imbalance != 0)),
        nonmanifold_vertices=edges.pinched_vertices(),
        components=len(np.unique(part)),
        inverted_components=inverted,
        inward_components=inward,
        unreferenced_vertices=_total(~used),
        euler_number=len(corners) - len(edges.faces) + len(surface),
    )


def _holes(points, surface, edges: Edges, finite) -> list[Hole]:
    """The loops of boundary edges, where nothing else is wrong along them."""
    rim = edges.ends[edges.faces == 1]
    if not len(rim) or not finite[surface].all() or (edges.imbalance[edges.faces == 2] != 0).any():
        return []
    return holes_of(manifold_of(surface, len(points)), points)


def one_mesh(vertices, faces, counting: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """One mesh as NumPy arrays, refused in the penalty's own words; `counting` admits any index.

    Raises:
        TypeError, ValueError: as `as_mesh`, and ValueError for a batch.
    """
    points, triangles = np.asarray(vertices), np.asarray(faces)
    # An empty list of faces has NumPy's default dtype and no columns; it is still no faces.
    if triangles.size == 0 and not isinstance(faces, np.ndarray | Array):
        triangles = np.zeros((0, 3), np.int64)
    with np.errstate(over="ignore"):  # 1e300 is no float32, which JAX wants by default
        as_mesh(points, np.zeros_like(triangles) if counting and len(points) else triangles)
    if points.ndim != 2:
        raise ValueError(
            f"vertices must be one mesh of shape (V, 3): got {points.shape}; take the meshes of a "
            "batch one by one."
        )
    return points, triangles


def _inside_out(
    points: Float[np.ndarray, "V 3"],
    surface: Int[np.ndarray, "F 3"],
    part: Int[np.ndarray, "F"],
    closed: Bool[np.ndarray, "F"],
) -> tuple[int, int]:
    """Closed components of negative volume: those outside and those inside of another's box."""
    faces, (names, part) = surface[closed], np.unique(part[closed], return_inverse=True)
    if not len(names):
        return 0, 0
    with np.errstate(invalid="ignore", over="ignore"):
        middle = points[np.unique(faces)].mean(axis=0)
        corner = points[faces] - middle
        six_volumes = np.einsum("fi,fi->f", corner[:, 0], np.cross(corner[:, 1], corner[:, 2]))
        volume = np.bincount(part, six_volumes)
        rounding = 1e-12 * np.bincount(part, np.abs(six_volumes))
    low, high = np.full((len(names), 3), np.inf), np.full((len(names), 3), -np.inf)
    np.minimum.at(low, part, corner.min(axis=1))
    np.maximum.at(high, part, corner.max(axis=1))
    outward = volume > rounding
    negative = np.flatnonzero(volume < -rounding)
    nested = [
        bool(((low[outward] <= low[k]) & (high[outward] >= high[k])).all(axis=1).any())
        for k in negative
    ]
    return len(nested) - sum(nested), sum(nested)


def _problems(check: MeshCheck) -> Iterable[str]:
    if n := check.nonfinite_vertices:
        yield f"{_count(n, 'vertex', 'vertices')} with NaN or infinity; remove or restore them"
    if n := check.out_of_range_faces:
        yield (
            f"{_count(n, 'face')} with an index outside of the {check.num_vertices} vertices; "
            "indices are 0-based"
        )
    if n := check.duplicate_faces:
        yield (
            f"{_count(n, 'face')} listed more than once; with trimesh: "
            "mesh.update_faces(mesh.unique_faces())"
        )
    if (n := check.open_sheets) and check.largest_hole is not None:
        what = "an open sheet" if n == 1 else f"{n} open sheets"
        hole = holes_in_words(check.holes, check.largest_hole)
        yield (
            f"{what}: {hole}, where up to {LARGEST:.0%} is closed by a fan; it "
            "encloses nothing. With trimesh: mesh.merge_vertices(merge_tex=True, "
            "merge_norm=True) if it is only split along seams; beside solids, sheet_penalty "
            "measures how much of it lies in them; else thicken it, or close it: "
            "trimesh.repair.fill_holes(mesh, use_fan=True)"
        )
    elif check.boundary_edges and check.largest_hole is None:
        yield (
            f"{_count(check.boundary_edges, 'boundary edge')} around "
            f"{_count(check.holes, 'hole')} that cannot be closed before the rest is put right"
        )
    if n := check.misoriented_edges:
        yield (
            f"{_count(n, 'edge')} that both faces run through in the same sense: the winding is "
            "inconsistent; with trimesh: trimesh.repair.fix_winding(mesh)"
        )
    if n := check.unbalanced_edges:
        yield (
            f"{_count(n, 'non-manifold edge')} with more faces one way than the other; remove the "
            "faces that stick out of the surface or lie within it"
        )
    if n := check.inverted_components:
        yield (
            f"{_count(n, 'inverted component')} of {check.components}: faces must be "
            "counter-clockwise seen from outside; with trimesh: "
            "trimesh.repair.fix_inversion(mesh, multibody=True)"
        )


def _warnings(check: MeshCheck) -> Iterable[str]:
    if not check.num_faces:
        yield "no faces: there is nothing that could intersect"
    if check.largest_hole is not None and not check.open_sheets:
        yield f"{holes_in_words(check.holes, check.largest_hole)}: closed by fans"
    if n := check.nonmanifold_edges - check.unbalanced_edges:
        yield f"{_count(n, 'non-manifold edge')} with as many faces one way as the other"
    if n := check.nonmanifold_vertices:
        yield f"{_count(n, 'vertex', 'vertices')} where parts touch: faces in more than one fan"
    if n := check.inward_components:
        yield (
            f"{_count(n, 'component')} turned inwards within another's bounding box: right for a "
            "cavity, else to be inverted"
        )
    if n := check.degenerate_faces:
        yield f"{_count(n, 'degenerate face')} with a repeated index; no ray sees them"
    if n := check.unreferenced_vertices:
        yield (
            f"{_count(n, 'unreferenced vertex', 'unreferenced vertices')}: part of the "
            "ratio, and of the screen that the rays must cover"
        )


def _count(number: int, singular: str, plural: str | None = None) -> str:
    return f"{number} {singular if number == 1 else plural or singular + 's'}"


def _total(mask: Any) -> int:
    return int(np.count_nonzero(mask))
