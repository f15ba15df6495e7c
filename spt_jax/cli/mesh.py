"""`spt-jax untangle MESH`: one mesh file made intersection-free by moving its vertices."""

import json as json_format
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Int

from spt_jax.cli.terminal import (
    err_console,
    measurable,
    out_console,
    progress_bar,
    show,
    user_errors,
)

if TYPE_CHECKING:
    from rich.table import Table

    from spt_jax.io.meshes.reading import MeshFile
    from spt_jax.untangle.mesh import UntangleMeshResult

# Text formats keep every digit, and .ply holds either precision; .glb and .stl hold float32, so the
# mesh must be intersection-free in float32.
_TEXT = (".obj", ".off")
_SINGLE = (".glb", ".stl")
_KNOWN = (*_TEXT, *_SINGLE, ".ply")


def untangle_mesh_file(
    path: Path,
    out: Path,
    *,
    fixed: Path | None = None,
    meshes: bool,
    rays: int | None,
    max_bytes: int | None = None,
    json: bool,
    quiet: bool,
) -> int:
    """Untangle one mesh; the exit code is 0 if it is intersection-free, and 1 otherwise.

    Args:
        path: the mesh that moves.
        out: folder for the results.
        fixed: a mesh that stays as it is, and that the other one is freed from, too.
        meshes, rays, max_bytes, json, quiet: as the command has them.
    """
    from spt_jax._query import as_rays
    from spt_jax.files.outputs import ensure_folder, write_json
    from spt_jax.io.mesh_files import open_mesh

    with user_errors():
        as_rays(rays)
        opened = open_mesh(path, max_bytes=max_bytes)
        given, suffix, notes = _as_stored(opened.vertices, path.suffix.lower())
        beside = None if fixed is None else open_mesh(fixed, max_bytes=max_bytes)
        given, faces, stays = _together(given, opened.faces, beside)
        folder = ensure_folder(out)
    own = len(opened.vertices)
    notes = [*opened.notes, *notes]
    if beside is not None:
        notes += [f"{beside.path.name}: {note}" for note in beside.notes]
    for note in notes:
        show(err_console(quiet), f"note: {note}", "yellow")
    start = time.perf_counter()
    with progress_bar(1, quiet) as state:
        from spt_jax._steps import Step
        from spt_jax.untangle.mesh import untangle_mesh

        def on_step(step: Step) -> None:
            pairs = f"{step.intersecting_pairs} intersecting pairs"
            state(f"{path.name}: attempt {step.stage + 1}, step {step.steps}, {pairs}")

        # Half the rays, as for poses: the last intersections do not hang on them.
        sampling: dict[str, Any] = {} if rays is None else {"rays": max(rays // 2, 1)}
        with measurable(path.name):
            result = untangle_mesh(given, faces, fixed=stays, on_step=on_step, **sampling)
        seconds = time.perf_counter() - start
        state("writing", done=1)
        report: dict[str, Any] = {
            "command": "untangle",
            "settings": {"mesh": str(path), "directions": 3, **sampling}
            | ({} if fixed is None else {"fixed": str(fixed)}),
            **result.as_dict(),
            "seconds": round(seconds, 3),
            "notes": notes,
        }
        with user_errors():
            report["mesh"] = f"{path.stem}_untangled{suffix}"
            written = opened.write(folder / report["mesh"], result.vertices[:own])
            report["notes"] = [*notes, *written]
            report["meshes"] = (
                _write_colored(folder, path.stem, given, result.vertices, faces, own, rays)
                if meshes
                else []
            )
            write_json(folder / "report.json", report)
    for note in written:
        show(err_console(quiet), f"note: {note}", "yellow")
    if json:
        print(json_format.dumps(report, indent=2))
    else:
        console = out_console(quiet)
        console.print(_table(result, seconds))
        also = "".join(f", {name}" for name in report["meshes"])
        show(console, f"in {folder}: {report['mesh']}, report.json{also}")
    if result.after.intersecting_pairs:
        show(
            err_console(quiet),
            f"not intersection-free: {result.after.intersecting_pairs} of "
            f"{result.before.intersecting_pairs} intersecting pairs are left; part the pieces by "
            "hand where they are deepest, or refine the mesh there",
            "red",
        )
    elif not result.is_free:
        show(
            err_console(quiet),
            f"not intersection-free: no faces intersect, but {result.after.volume:.4g} units³ of "
            "overlap are left; a part enclosed in another, or lying on a copy of its own, is not "
            "pushed out: move it by hand, or take it out",
            "red",
        )
    return 0 if result.is_free else 1


def _together(
    vertices: Float[np.ndarray, "V 3"], faces: Int[np.ndarray, "F 3"], beside: "MeshFile | None"
) -> tuple[Float[np.ndarray, "W 3"], Int[np.ndarray, "G 3"], Bool[np.ndarray, "W"] | None]:
    """A mesh and behind it one that stays, and which vertices that are.

    Raises:
        ValueError: a mesh that cannot be measured; the message names what is wrong.
    """
    from spt_jax._mesh_check import check_mesh

    if beside is None:
        check_mesh(vertices, faces).raise_if_unfit()
        return vertices, faces, None
    try:
        check_mesh(beside.vertices, beside.faces).raise_if_unfit()
    except ValueError as error:
        raise ValueError(f"fixed must be a mesh of closed solids: {beside.path}: {error}") from None
    both = np.concatenate([vertices, beside.vertices.astype(vertices.dtype)])
    stays = np.arange(len(both)) >= len(vertices)
    return both, np.concatenate([faces, beside.faces + len(vertices)]), stays


def _as_stored(
    vertices: Float[np.ndarray, "V 3"], suffix: str
) -> tuple[Float[np.ndarray, "V 3"], str, list[str]]:
    """The vertices as the written file will hold them, its suffix, and what there is to say."""
    if suffix in _TEXT:
        return vertices, suffix, []
    from spt_jax.io.mesh_files import fits_single, single_rounding

    rounding, notes = single_rounding(vertices), []
    if suffix == ".gltf":
        notes.append(".gltf files are written as .glb, all in one file")
        suffix = ".glb"
    if suffix not in _KNOWN:
        notes.append(f"{suffix} files are read only; the mesh is written as .ply")
        suffix = ".ply"
    if suffix in _SINGLE and not fits_single(vertices):
        notes.append(
            f"{suffix} files hold single precision, which would move vertices by up to "
            f"{rounding:.2g} this far from the origin; the mesh is written as .ply"
        )
        suffix = ".ply"
    double = suffix == ".ply" and rounding > 0
    return vertices if double else vertices.astype(np.float32), suffix, notes


def _table(result: "UntangleMeshResult", seconds: float) -> "Table":
    from rich.table import Table

    table = Table(header_style="bold")
    for heading in ("", "before", "after"):
        table.add_column(heading, justify="right" if heading else "left", no_wrap=True)
    before, after = result.before, result.after
    color = "green" if result.is_free else "red"
    left = f"[{color}]{after.intersecting_pairs}[/{color}]"
    table.add_row("intersecting pairs", f"{before.intersecting_pairs}", left)
    table.add_row("overlap, units³", f"{before.volume:.4g}", f"{after.volume:.4g}")
    table.add_row("vertices in overlap", f"{before.ratio:.2%}", f"{after.ratio:.2%}")
    table.add_row("vertices moved", "", f"{result.moved}")
    table.add_row("median displacement", "", f"{result.median_displacement:.4g}")
    table.add_row("largest displacement", "", f"{result.largest_displacement:.4g}")
    table.add_row("  of its part's size", "", f"{result.relative_displacement:.2%}")
    table.add_row("triangles turned over", "", f"{result.flipped_triangles}")
    table.add_row("steps, time", "", f"{result.steps}, {seconds:.1f} s")
    return table


def _write_colored(
    folder: Path,
    stem: str,
    before: Float[np.ndarray, "V 3"],
    after: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    own: int,
    rays: int | None,
) -> list[str]:
    from spt_jax.io.mesh_files import write_mesh

    names = []
    for when, vertices in (("before", before), ("after", after)):
        names.append(f"{stem}_{when}.glb")
        labels = _labels(vertices, faces, own, rays)
        write_mesh(folder / names[-1], vertices, faces, labels)
    return names


def _labels(
    vertices: Float[np.ndarray, "V 3"],
    faces: Int[np.ndarray, "F 3"],
    own: int,
    rays: int | None,
) -> Int[np.ndarray, "V"]:
    """Labels of a mesh, whose first vertices move; of a garment by where it lies in the others."""
    from spt_jax._labels import classify_vertices
    from spt_jax._mesh_check import check_mesh
    from spt_jax._sheets import sheet_report

    moves = faces[:, 0] < own
    body = faces[~moves] - own
    if len(body) and check_mesh(vertices[:own], faces[moves]).largest_hole is not None:
        labels = sheet_report(vertices[:own], faces[moves], vertices[own:], body).labels
        return np.concatenate([labels, np.zeros(len(vertices) - own, labels.dtype)])
    return np.asarray(classify_vertices(vertices, faces, rays=rays).labels)
