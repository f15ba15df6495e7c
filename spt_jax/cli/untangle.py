"""`spt-jax untangle`: a pose file or a mesh file, freed of self-intersections."""

from functools import partial
from pathlib import Path
from typing import Literal

import tyro

from spt_jax.cli.mesh import untangle_mesh_file
from spt_jax.cli.rigs import untangle_rig_file
from spt_jax.cli.terminal import (
    err_console,
    progress_bar,
    show,
    user_errors,
    warnings_as,
)


def untangle(
    poses: tyro.conf.Positional[Path],
    out: Path = Path("untangled"),
    frames: str = "all",
    people: str = "all",
    body: str = "anny",
    folds: Literal["ignore", "remove", "count"] = "ignore",
    fold_distance: float | None = None,
    keep_contact: bool = False,
    meshes: bool = False,
    like_input: bool = False,
    together: bool = False,
    fixed: Path | None = None,
    frame_by_frame: bool = False,
    fps: float | None = None,
    up: str = "auto",
    rays: int | None = None,
    anew: bool = False,
    max_bytes: int | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Remove the self-intersections of motions or poses in a pose file, of a rig or of a mesh file.

    Consecutive frames are a motion, which is untangled as a whole and stays as smooth as it was.
    Finished work is saved, so that the same command continues an interrupted run.

    Takes the pose files of AMASS, SMPLify-X, PROX, HMR2, PHALP, WHAM, VIBE, PyMAF, GVHMR, TRAM,
    ROMP, BEV, SLAHMR, BEDLAM, AIST++, 3DPW, MOYO, EasyMocap, MMHuman3D, Motion-X and VPoser, BVH,
    and files that this command wrote; their suffixes do not matter. Writes poses.npz (AMASS layout,
    in the body's joints; of several people one file each, poses_NAME.npz) and report.json. Each
    finished frame is kept in OUT/unfinished until all are done.

    Of a rigged character (.glb, .gltf or .vrm with a skin) every animation is untangled and added
    to a copy of the file, NAME_untangled.glb, and written as .npz and .bvh.

    Of a mesh (.ply, .obj, .stl, .off, .glb, ...) the vertices move, and NAME_untangled is written
    in the same format; the exit code is 1 if something still intersects or overlaps. With --fixed
    BODY, a garment, open or closed, is moved out of a body that stays where it is.

    Args:
        poses: the pose file (.npz, .npy, .pkl, .pt, .json, .bvh), a rig or a mesh file.
        out: folder for the results, made where missing.
        frames: which frames: numbers from 0, ranges and names, such as 0,5,10-12 or crawl/0012
        people: whose frames, of a file of several: names or numbers from 0, such as 0,2; of a rig
            file the one character
        body: "anny", the body that comes with the package, or an SMPL, SMPL-H or SMPL-X model file
            (.npz, .pkl).
        folds: how folds of skin at bent joints are treated: "ignore" leaves them, "remove" moves
            the posed vertices until nothing intersects (which only the meshes show, not the poses),
            "count" treats them as collisions. The report says how much is excluded.
        fold_distance: intersecting skin nearer than this, along the skin at rest and in meters, is
            a fold; not given: a distance for each place, 0.3 on trunk and limbs and 0.02 to 0.04 on
            fingers.
        keep_contact: parts within 20 mm of each other, such as clapping hands and crossed arms,
            stay as near as they are.
        meshes: write a .glb of each frame before and after, colored by label; of a motion one
            that plays before and after side by side.
        like_input: write NAME_untangled too, the input in its own structure with the new poses.
        together: treat the people of a file as one scene and remove overlaps within and between
            them, which are reported separately. Frame by frame, people are also moved as a whole;
            in a motion they stay where they are.
        fixed: for a mesh: another mesh file that stays where it is, such as the body under a
            garment; the first mesh is moved out of it. An open mesh is a garment, whose
            self-intersections are not considered.
        frame_by_frame: untangle each frame by itself, like single poses.
        fps: frames per second; not given: those of the file, or 30.
        up: the axis that is up, by which standing feet are detected: x, y, z, -x, -y, -z; "auto":
            the one along which heads are above hips.
        rays: how many rays to cast along the longer side of each of three beams; the search uses
            half as many; not given: none, everything is measured exactly.
        anew: discard what an unfinished run left in the folder.
        max_bytes: how large an input file may be, and its arrays once unpacked; not given: 1 GiB.
        json: print the report as JSON instead of the table.
        quiet: print only errors.
    """
    from spt_jax.io.pose_files import is_pose_file
    from spt_jax.io.rigs.reading import is_rig_file

    contacts = "found" if keep_contact else None
    with user_errors():
        rigged = is_rig_file(poses, max_bytes=max_bytes)
    if rigged:
        with user_errors():
            _refuse(
                "a rig",
                fixed=fixed is not None,
                like_input=like_input,
                together=together,
                body=body != "anny",
                frame_by_frame=frame_by_frame,
                fps=fps is not None,
                up=up != "auto",
            )
        return untangle_rig_file(
            poses,
            out,
            frames=frames,
            people=people,
            options={
                "rays": rays,
                "directions": 3,
                "folds": folds,
                "fold_distance": fold_distance,
                "contacts": contacts,
            },
            meshes=meshes,
            anew=anew,
            max_bytes=max_bytes,
            json=json,
            quiet=quiet,
        )
    if not is_pose_file(poses):
        with user_errors():
            _refuse(
                "a mesh",
                frames=frames != "all",
                people=people != "all",
                like_input=like_input,
                together=together,
                body=body != "anny",
                folds=folds != "ignore",
                fold_distance=fold_distance is not None,
                keep_contact=keep_contact,
                frame_by_frame=frame_by_frame,
                fps=fps is not None,
                up=up != "auto",
                anew=anew,
            )
        return untangle_mesh_file(
            poses,
            out,
            fixed=fixed,
            meshes=meshes,
            rays=rays,
            max_bytes=max_bytes,
            json=json,
            quiet=quiet,
        )
    from spt_jax._exclusions import as_fold_distance
    from spt_jax._query import as_rays
    from spt_jax.cli.motion_frames import as_motions, pieces_of
    from spt_jax.cli.motions import chosen, write_like_input, write_motions
    from spt_jax.cli.posed import posed_on
    from spt_jax.cli.together import untangle_together
    from spt_jax.files.outputs import ensure_folder, write_json

    with user_errors():
        as_rays(rays)
        as_fold_distance(fold_distance)
        _refuse("a pose file", fixed=fixed is not None)
        asked = chosen(poses, people, frames, max_bytes)
        if together and like_input:
            raise ValueError(
                "like_input writes rotations alone: got it with together, which moves people, too; "
                "leave one of them out."
            )
        folder = ensure_folder(out)
    pieces = pieces_of(asked, together=together)
    whole, note = as_motions(pieces, frame_by_frame=frame_by_frame, folds=folds, rays=rays)
    if note is not None:
        show(err_console(quiet), f"note: {note}", "yellow")
    if together and not (whole and len(pieces[0].rows) > 1):
        return untangle_together(
            asked,
            body,
            folder,
            {
                "rays": rays,
                "directions": 3,
                "folds": folds,
                "fold_distance": fold_distance,
                "contacts": contacts,
            },
            meshes=meshes,
            anew=anew,
            max_bytes=max_bytes,
            json=json,
            quiet=quiet,
        )
    with progress_bar(len(asked.rows), quiet) as state:
        state("loading the body")
        from spt_jax.cli.frames import (
            as_report,
            made_from,
            print_summary,
            untangle_frames,
            write_meshes,
        )
        from spt_jax.cli.motion_command import MotionOptions, untangle_as_motions
        from spt_jax.cli.unfinished import UnfinishedRun, manifest_of

        said: list[str] = []
        with user_errors(), warnings_as(said):
            model, motion, notes = posed_on(asked, body, max_bytes)
        notes = said + notes
        for note in notes:
            show(err_console(quiet), f"note: {note}", "yellow")
        if whole:
            wanted = MotionOptions(
                fold_distance, contacts, fps, up, meshes, like_input, anew, json, quiet
            )
            return untangle_as_motions(
                model, motion, asked, pieces, folder, notes, wanted, state, body
            )
        options = {
            "rays": rays,
            "directions": 3,
            "folds": folds,
            "fold_distance": fold_distance,
            "contacts": contacts,
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
            state("writing", done=len(asked.rows))
            report = as_report("untangle", done, {"poses": str(poses), "body": body, **options})
            with user_errors():
                written = write_meshes(folder, done, model.faces, (".glb",)) if meshes else []
                report["meshes"] = written
                report["structure"] = asked.file.structure
                files = write_motions(folder, done, motion, asked)
                if like_input:
                    name, stale = write_like_input(folder, done, motion, asked, model.joint_names)
                    files.append(name)
                    for note in stale:
                        show(err_console(quiet), f"note: {note}", "yellow")
                    notes += stale
                report["files"], report["notes"] = files, notes
                write_json(folder / "report.json", report)
                run.finish()
    print_summary(done, report, folder, json=json, quiet=quiet)
    return 0


def _refuse(what: str, **used: bool) -> None:
    for name, given in used.items():
        if given:
            of = "meshes" if name == "fixed" else "pose files"
            raise ValueError(f"{name} is for {of}: got it with {what}; leave it out.")
