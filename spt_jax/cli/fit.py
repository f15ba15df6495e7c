"""`spt-jax fit`: bodies from a file of 2D keypoints."""

import json as json_format
import time
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal, TypeAlias

import tyro

from spt_jax.cli.datasets import RunOptions, folder_camera, over_folder, refuse_for_folder
from spt_jax.cli.terminal import (
    CommandError,
    err_console,
    out_console,
    progress_bar,
    show,
    user_errors,
    warnings_as,
)
from spt_jax.fit.regularizers import regularizer_names

if TYPE_CHECKING:
    RegularizerName: TypeAlias = str
else:  # so that the help lists them
    RegularizerName = Literal[regularizer_names()]


def fit(
    keypoints: tyro.conf.Positional[Path],
    out: Path = Path("fitted"),
    layout: str | None = None,
    names: Annotated[str | None, tyro.conf.arg(name="map")] = None,
    camera: Path | None = None,
    focal: float | None = None,
    center: tuple[float, float] | None = None,
    image: Path | None = None,
    people: str = "all",
    body: str = "anny",
    regularizer: RegularizerName = "spt",
    fold_distance: float | None = None,
    robust: float | Literal["auto", "off"] = "auto",
    fit_shape: bool = False,
    together: bool = False,
    engine: Literal["local", "ray"] = "local",
    processes: int | Literal["auto"] = "auto",
    shard: str | None = None,
    ray_address: str | None = None,
    frames_per_second: float = 30.0,
    anew: bool = False,
    retry: bool = False,
    max_bytes: int | None = None,
    json: bool = False,
    quiet: bool = False,
) -> int:
    """Find the 3D poses of the people in a file of 2D keypoints, or in each file of a folder.

    Takes COCO's annotations and results, what MMPose, AlphaPose, Detectron2, Ultralytics and
    OpenPose write as JSON, DeepLabCut's tables, and JSON or .npz files of this project
    ({"layout", "people": [[[x, y, confidence], ...], ...]}). Writes poses.npz (AMASS layout), a
    .glb of each person colored by label, a picture of each image with the bodies over it, and
    report.json. A folder of OpenPose's frames (NAME_NUMBER_keypoints.json) is a sequence: people
    are followed from frame to frame, stay near the pose that they had, and are written as a motion
    each (track_0.npz, ...). The exit code is 1 if somebody could not be fitted,
    or if what was found lies outside any photograph. What is done is kept in OUT/unfinished until
    all is: a run that was ended goes on with the same command.

    Of any other folder each file becomes an .npz of poses, with a manifest, a summary and a report
    as `clean` writes them; people are fitted one by one.

    Args:
        keypoints: the file, .json, .npz or .csv, or a folder of them.
        out: folder for the results, made where missing.
        layout: the order of the keypoints, such as coco17, body25_hands, wholebody133, mpii16 or
            smpl24, or their names with commas between them; what the file says if not given.
        names: what keypoints of the file are whose names are not known, such as
            left_wrist=lpaw,nose=snout.
        camera: a .json or .npz file with a 3 x 4 matrix, or with focal and center. Without it and
            the next two, one that spans 55 degrees over the image's longer side.
        focal: focal length in pixels.
        center: principal point in pixels; the image's middle if not given.
        image: the photograph, or a folder of them, to draw over; a blank canvas if not given.
        people: which people: rows from 0, ranges, images and names, such as 0,3-5 or 000000000139
        body: "anny", the body that comes with the package, or an SMPL, SMPL-H or SMPL-X model file
            (.npz, .pkl).
        regularizer: what keeps a body from passing through itself: the self-intersection penalty,
            nothing, or the paper's rivals.
        fold_distance: how near to each other, along the skin at rest and in metres, what intersects
            is a fold and is excluded; not given: as near as the place allows, 0.3 on trunk and
            limbs and 0.02 to 0.04 on fingers.
        robust: how far off, in pixels, a keypoint is half taken for a mistake (Geman-McClure);
            "auto" is 10 % of the larger side of the box around the person's keypoints; "off" trusts
            them all.
        fit_shape: fit the body's shape too.
        together: fit the people of an image as one scene, so that they do not pass through each
            other either.
        engine: of a folder: "local", processes of this machine, or "ray", a Ray cluster.
        processes: of a folder: how many; "auto": as many as there is room for.
        shard: of a folder: i/n with i from 0, one of n parts of the files alone.
        ray_address: of the cluster; not given: RAY_ADDRESS, or one on this machine.
        frames_per_second: of the motions that are written of a folder of frames.
        anew: throw away what is done of an unfinished run in the folder.
        retry: of a folder: try files again that failed.
        max_bytes: what each file that is read, its arrays and a photograph's pixels may take; not
            given: 256 MiB of JSON, 1 GiB of anything else.
        json: print the report as JSON in place of the table.
        quiet: print errors alone.
    """
    if robust not in ("auto", "off") and not robust > 0:
        raise CommandError(
            f"robust must be a positive number of pixels, auto or off: got {robust}."
        )
    from spt_jax.keypoints.folders import is_sequence

    sequence = is_sequence(keypoints)
    if keypoints.is_dir() and not sequence:
        with user_errors():
            seen = folder_camera(camera, focal, center, max_bytes)
            refuse_for_folder(
                image=image is not None,
                people=people != "all",
                together=together,
                map=names is not None,
            )
        from spt_jax.datasets import fit as start_fit

        return over_folder(
            start_fit,
            keypoints,
            out,
            RunOptions(
                engine=engine,
                processes=processes,
                shard=shard,
                ray_address=ray_address,
                anew=anew,
                retry=retry,
                max_bytes=max_bytes,
                json=json,
                quiet=quiet,
            ),
            layout=layout,
            camera=seen,
            body=body,
            regularizer=regularizer,
            fold_distance=fold_distance,
            robust=robust,
            fit_shape=fit_shape,
        )
    from spt_jax._exclusions import as_fold_distance
    from spt_jax.cli.annotated import as_map, gather, of_the_body, tracks_of
    from spt_jax.files.outputs import ensure_folder, write_json
    from spt_jax.keypoints import keypoint_regressor, read_keypoints

    with user_errors():
        as_fold_distance(fold_distance)
        file = read_keypoints(keypoints, layout=layout, map=as_map(names), max_bytes=max_bytes)
        chosen, notes = gather(
            keypoints,
            file,
            people=people,
            image=image,
            camera=camera,
            focal=focal,
            center=center,
            max_bytes=max_bytes,
        )
    start = time.perf_counter()
    with progress_bar(len(chosen), quiet) as state:
        state("loading the body")
        from spt_jax.body import load_body
        from spt_jax.cli.fitted import (
            as_report,
            draw,
            people_table,
            scene_lines,
            summary,
            write_bodies,
            write_motions,
        )
        from spt_jax.cli.fitting import fit_everyone, made_from, scenes_of
        from spt_jax.cli.frames import left_out
        from spt_jax.cli.unfinished import UnfinishedRun, manifest_of
        from spt_jax.io.pose_files import check_joints

        with user_errors():
            with warnings_as(notes):
                model = load_body(body, max_bytes=max_bytes)
            check_joints(body, model.num_joints)
            orders = {one.person.layout for one in chosen}
            chosen, lost = of_the_body(
                chosen, {order: keypoint_regressor(model, order).placed for order in orders}
            )
            notes += lost
            tracks = tracks_of(chosen) if sequence and not together else None
            groups = scenes_of(chosen) if together else [[one] for one in chosen]
            folder = ensure_folder(out)
        if any(one.camera_source == "estimated" for one in chosen):
            notes.append(
                "the camera is not known; one that spans 55 degrees is taken, and distances are as "
                "uncertain as that (--camera, --focal)"
            )
        for note in notes:
            show(err_console(quiet), f"note: {note}", "yellow")
        options = {
            "regularizer": regularizer,
            "fold_distance": fold_distance,
            "robust": robust,
            "fit_shape": fit_shape,
        }
        with user_errors():
            manifest = manifest_of(
                "fit", options | {"together": together, "tracks": tracks}, model, made_from(groups)
            )
            run = UnfinishedRun(folder, manifest, say=partial(show, err_console(quiet)), anew=anew)
        with run:
            done, scenes = fit_everyone(
                model, groups, **options, state=state, run=run, tracks=tracks
            )
            with user_errors():
                state("writing", done=len(chosen))
                meshes = write_bodies(folder, done, model, fit_shape)
                motions = write_motions(folder, done, tracks or {}, fit_shape, frames_per_second)
                state("drawing")  # after the rest is safe
                pictures, missing = draw(folder, done, model.faces)
                settings = {
                    "keypoints": str(keypoints),
                    "layout": layout,
                    "map": names,
                    "people": people,
                    "body": body,
                    **options,
                    "together": together,
                }
                report = as_report(done, scenes, settings)
                report["seconds"] = round(time.perf_counter() - start, 3)
                report["notes"] = notes
                report["meshes"] = meshes
                report["motions"] = motions
                report["pictures"] = pictures
                report["pictures_left_out"] = missing
                write_json(folder / "report.json", report)
                run.finish()
    lost = [one for one in done if not one.usable]
    outside = [one for one in done if one.usable and one.outside]
    if json:
        print(json_format.dumps(report, indent=2))
    else:
        console = out_console(quiet)
        console.print(people_table(done))
        show(console, summary(done))
        show(console, left_out([], (one.overlap for one in done if one.overlap)))
        for line in scene_lines(scenes):
            show(console, line)
        drawn = f", {', '.join(pictures[:3])}{', ...' if len(pictures) > 3 else ''}"
        show(
            console,
            f"{report['seconds']:.0f} s; in {folder}: {len(meshes)} meshes (.glb), poses.npz, "
            f"report.json{drawn if pictures else ''}",
        )
    if missing:
        show(err_console(quiet), f"Pictures were left out: {missing}", "yellow")
    for one in lost:
        show(err_console(quiet), f"{one.name} could not be fitted; see report.json", "red")
    for one in outside:
        show(err_console(quiet), f"{one.name}: {one.reason}; check camera and keypoints", "red")
    return 1 if lost or outside else 0
