"""`spt-jax check`: whether a mesh file self-intersects."""

import json as json_format
from pathlib import Path
from typing import Any

import tyro

from spt_jax.cli.terminal import (
    CommandError,
    err_console,
    measurable,
    out_console,
    show,
    user_errors,
)


def check(
    mesh: tyro.conf.Positional[Path],
    solids: Path | None = None,
    rays: int | None = None,
    max_bytes: int | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Report the self-intersections of a mesh file.

    The exit code is 0 if no triangles intersect and nothing overlaps, 1 if the mesh
    self-intersects, and 2 if that cannot be decided because the mesh is unreadable, open,
    inconsistently wound, inside out or too crumpled. Defects are listed with counts. Contact is
    not an intersection.

    Args:
        mesh: the file, such as body.ply, body.obj, body.stl or body.glb.
        solids: a file of closed meshes for an open one, such as a body under a garment: reports how
            much of the garment lies inside them, and how deep, instead of self-intersections.
        rays: how many rays to cast along the longer side of each of three beams; not given: none,
            everything is measured exactly.
        max_bytes: what the file and its arrays may take; not given: 1 GiB.
        json: print the report as JSON.
        quiet: print only errors.
    """
    console = out_console(quiet)
    found: dict[str, Any] = {
        "file": str(mesh),
        "error": None,
        "warning": None,
        "notes": [],
        "mesh": None,
        "intersection": None,
    }
    try:
        code, shown = (
            _judge(mesh, rays, max_bytes, found)
            if solids is None
            else _judge_sheet(mesh, solids, rays, max_bytes, found)
        )
    except CommandError as error:
        if not json:
            raise
        found["error"], code, shown = str(error), 2, []
    if json:
        # Not through rich, which would wrap long lines.
        print(json_format.dumps({**found, "exit_code": code}, indent=2))
    else:
        for part in shown:
            console.print(part)
        for note in found["notes"]:
            show(err_console(quiet), f"note: {note}", "yellow")
        if found["warning"] is not None:
            show(err_console(quiet), f"warning: {found['warning']}", "yellow")
    return code


def _judge(
    path: Path, rays: int | None, max_bytes: int | None, found: dict[str, Any]
) -> tuple[int, list[Any]]:
    from spt_jax._mesh_check import check_mesh
    from spt_jax._query import as_rays
    from spt_jax._report import intersection_report
    from spt_jax.io.mesh_files import open_mesh

    with user_errors():
        as_rays(rays)
        opened = open_mesh(path, max_bytes=max_bytes)
    vertices, faces = opened.vertices, opened.faces
    found["notes"] = list(opened.notes)
    checked = check_mesh(vertices, faces)
    found["mesh"] = checked.as_dict()
    if not checked.ok:
        return 2, [checked, "[red]cannot be judged before that is put right[/red]"]
    with measurable(path.name):
        report = intersection_report(vertices, faces, rays=rays)
    found["intersection"] = report.as_dict()
    verdict = (
        "[red]it self-intersects[/red]"
        if not report.is_free
        else "[green]it does not self-intersect[/green]"
    )
    if rays is None and not report.exact:
        found["warning"] = (
            "the exact sums do not close on this mesh, so rays were cast and the volume is as good "
            "as they are; please report the file"
        )
    return int(not report.is_free), [checked, report, verdict]


def _judge_sheet(
    path: Path, solids: Path, rays: int | None, max_bytes: int | None, found: dict[str, Any]
) -> tuple[int, list[Any]]:
    from spt_jax._mesh_check import check_mesh
    from spt_jax._sheets import sheet_report
    from spt_jax.io.mesh_files import open_mesh

    with user_errors():
        if rays is not None:
            raise ValueError("rays cannot be cast at an open mesh: got them with solids.")
        sheet, body = (open_mesh(file, max_bytes=max_bytes) for file in (path, solids))
    found["solids"] = str(solids)
    found["notes"] = [*sheet.notes, *(f"{solids.name}: {note}" for note in body.notes)]
    checked = check_mesh(body.vertices, body.faces)
    found["mesh"] = checked.as_dict()
    if not checked.ok:
        why = f"[red]{solids.name} cannot be judged before that is put right[/red]"
        return 2, [checked, why]
    with measurable(path.name):
        report = sheet_report(sheet.vertices, sheet.faces, body.vertices, body.faces)
    found["intersection"] = report.as_dict()
    verdict = (
        f"[green]nothing of it lies in {solids.name}[/green]"
        if report.is_free
        else f"[red]it reaches into {solids.name}[/red]"
    )
    return int(not report.is_free), [report, verdict]
