"""`spt-jax untangle`: a pose file or a mesh file, freed of self-intersections."""

import json as json_format
import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Literal

import numpy as np
import tyro

from spt_jax.commands.mesh import untangle_mesh_file
from spt_jax.commands.terminal import err_console, out_console, progress_bar, show, user_errors

if TYPE_CHECKING:
    from spt_jax.body import BodyModel
    from spt_jax.body.pose_files import PoseFile
    from spt_jax.commands.frames import Motion


def untangle(
    poses: tyro.conf.Positional[Path],
    out: Path = Path("untangled"),
    frames: str = "all",
    body: str = "anny",
    folds: Literal["ignore", "remove", "count"] = "ignore",
    fold_distance: float | None = None,
    meshes: bool = False,
    rays: int | None = None,
    anew: bool = False,
    max_bytes: int | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Free the poses of an .npz file from self-intersections, frame by frame, or one mesh file.

    Takes AMASS files, parameters of SMPL, SMPL-H and SMPL-X, and files that this command wrote.
    Writes poses.npz (AMASS layout, in the body's joints) and report.json. Each frame that is done
    is kept in OUT/unfinished until all are: a run that was ended goes on with the same command.

    Of a mesh (.ply, .obj, .stl, .off, .glb, ...) the vertices move, and NAME_untangled is written
    in the same format; the exit code is 1 if something still intersects or overlaps.

    Args:
        poses: the pose file, or a mesh file of any other suffix than .npz.
        out: folder for the results, made where missing.
        frames: which frames: numbers from 0, ranges and names, such as 0,5,10-12 or crawl/0012
        body: "anny", the body that comes with the package, or an SMPL, SMPL-H or SMPL-X model file
            (.npz, .pkl).
        folds: of a posed body, what becomes of skin that folds where a joint bends: "ignore" leaves
            it, "remove" frees the posed vertices of all that still crosses (only the meshes show
            it, the poses do not), "count" takes folds for collisions. A line says how much is left
            out.
        fold_distance: how near to each other, along the skin at rest and in metres, what intersects
            is a fold; not given: as near as the place allows, 0.3 on trunk and limbs and 0.02 to
            0.04 on fingers.
        meshes: write a .glb of each frame before and after, coloured by label.
        rays: how many rays to cast along the longer side of each of three beams; the search uses
            half as many; not given: none, everything is measured exactly.
        anew: throw away what is done of an unfinished run in the folder.
        max_bytes: how large an input file may be, and its arrays once unpacked; not given: 1 GiB.
        json: print the report as JSON in place of the table.
        quiet: print errors alone.
    """
    if poses.suffix.lower() != ".npz":
        with user_errors():
            _refuse_for_mesh(
                frames=frames != "all",
                body=body != "anny",
                folds=folds != "ignore",
                fold_distance=fold_distance is not None,
                anew=anew,
            )
        return untangle_mesh_file(
            poses, out, meshes=meshes, rays=rays, max_bytes=max_bytes, json=json, quiet=quiet
        )
    from spt_jax.arguments import as_rays
    from spt_jax.body.pose_files import read_poses
    from spt_jax.exclusions import as_fold_distance
    from spt_jax.output_files import ensure_folder, write_json

    with user_errors():
        as_rays(rays)
        as_fold_distance(fold_distance)
        given = read_poses(poses, max_bytes=max_bytes)
        rows = select_frames(given.names, frames)
        folder = ensure_folder(out)
    with progress_bar(len(rows), quiet) as state:
        state("loading the body")
        from spt_jax.body import load_body
        from spt_jax.commands.frames import (
            as_report,
            before_after_table,
            left_out,
            made_from,
            summary,
            untangle_frames,
            write_meshes,
            write_motion,
        )
        from spt_jax.commands.unfinished import UnfinishedRun, manifest_of

        with user_errors():
            model = load_body(body, num_shape=_num_shape(given), max_bytes=max_bytes)
        motion, notes = _motion(given, rows, model, body)
        for note in notes:
            show(err_console(quiet), f"note: {note}", "yellow")
        options = {
            "rays": rays,
            "directions": 3,
            "folds": folds,
            "fold_distance": fold_distance,
        }
        with user_errors():
            manifest = manifest_of(
                "untangle", options | {"meshes": meshes}, model, made_from(motion)
            )
            run = UnfinishedRun(folder, manifest, say=partial(show, err_console(quiet)), anew=anew)
        with run:
            done = untangle_frames(
                model, motion, **options, state=state, run=run, keep_vertices=meshes
            )
            state("writing", done=len(rows))
            report = as_report("untangle", done, {"poses": str(poses), "body": body, **options})
            with user_errors():
                written = write_meshes(folder, done, model.faces, (".glb",)) if meshes else []
                report["meshes"] = written
                report["notes"] = notes
                write_motion(folder / "poses.npz", done, motion)
                write_json(folder / "report.json", report)
                run.finish()
    if json:
        print(json_format.dumps(report, indent=2))
        return 0
    console = out_console(quiet)
    console.print(before_after_table(done))
    show(console, summary(done))
    show(console, left_out((f.before for f in done), (f.after for f in done)))
    also = f", {len(report['meshes'])} meshes (.glb)" if meshes else ""
    show(console, f"in {folder}: poses.npz, report.json{also}")
    return 0


def _refuse_for_mesh(**used: bool) -> None:
    for name, given in used.items():
        if given:
            raise ValueError(f"{name} is for pose files (.npz): got it with a mesh; leave it out.")


def select_frames(names: Sequence[str], wanted: str) -> list[int]:
    """Rows of the frames asked for, in that order, each once; all of them for "all".

    Raises:
        ValueError: something that is neither a name, nor a row, nor a range of rows.
    """
    if wanted == "all":
        return list(range(len(names)))
    rows: list[int] = []
    for item in map(str.strip, wanted.split(",")):
        ends = re.fullmatch(r"(\d+)(?:-(\d+))?", item)
        if item in names:
            rows.append(names.index(item))
            continue
        first, last = (int(ends[1]), int(ends[2] or ends[1])) if ends else (1, 0)
        if not first <= last < len(names):
            raise ValueError(
                f"frames must be rows 0 to {len(names) - 1}, ranges of them or names such as "
                f"{names[0]!r}: got {item!r}; separate several by commas."
            )
        rows += range(first, last + 1)
    return list(dict.fromkeys(rows))


def _num_shape(given: "PoseFile") -> int:
    return 10 if given.shape is None else max(10, given.shape.shape[-1])


def _motion(
    given: "PoseFile", rows: Sequence[int], model: "BodyModel", body: str
) -> tuple["Motion", list[str]]:
    """The frames asked for on the body, and what of them had to be left out."""
    from spt_jax.body.poses import SMPL_LAYOUTS
    from spt_jax.commands.frames import Motion

    notes = []
    shape = given.shape
    if shape is not None and body == "anny":
        notes.append(
            "the file's shape is in SMPL's components, which the embedded body does not have; "
            "its mean shape is used (--body takes an SMPL file)"
        )
        shape = None
    elif shape is not None and shape.shape[-1] > model.num_shape:
        notes.append(f"shape components after the body's {model.num_shape} are left out")
        shape = shape[..., : model.num_shape]
    if shape is not None:
        shape = np.broadcast_to(shape, (len(given.pose), shape.shape[-1]))[rows]
    layout = SMPL_LAYOUTS[given.pose.shape[1]]
    turned = np.any(given.pose[rows], axis=(0, 2)).tolist()
    lost = [name for name, used in zip(layout, turned, strict=True) if used]
    lost = [name for name in lost if name not in model.joint_names]
    if lost:
        shown = ", ".join(lost[:4]) + (", ..." if len(lost) > 4 else "")
        notes.append(f"the body lacks {shown}; their rotations are left out")
    pose = np.asarray(model.pose_from_smpl(given.pose[rows].astype(np.float32)))
    if shape is not None:
        shape = shape.astype(np.float32)
    translation = given.translation
    if translation is not None:
        translation = translation[rows].astype(np.float32)
    return Motion([given.names[row] for row in rows], pose, shape, translation), notes
