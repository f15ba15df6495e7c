"""`spt-jax untangle RIG`: the animations of a rigged character, freed and written back."""

import re
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spt_jax.cli.frames import Frame, Motion
from spt_jax.cli.terminal import err_console, progress_bar, show, user_errors

if TYPE_CHECKING:
    from spt_jax.io.rigs.clips import Clip
    from spt_jax.io.rigs.reading import RigFile


def untangle_rig_file(
    path: Path,
    out: Path,
    *,
    frames: str,
    people: str,
    options: dict[str, Any],
    meshes: bool,
    anew: bool,
    max_bytes: int | None,
    json: bool,
    quiet: bool,
) -> int:
    """Untangle the animations of one character; of a file without any, the pose that it has."""
    from spt_jax._exclusions import as_fold_distance
    from spt_jax._query import as_rays
    from spt_jax.files.outputs import ensure_folder, write_json

    with user_errors():
        as_rays(options["rays"])
        as_fold_distance(options["fold_distance"])
        rig = _character(path, people, max_bytes)
        clips = [rig.clip(name) for name in rig.animations] or [rig.clip()]
        motion, places = motion_of_clips(clips, frames)
        folder = ensure_folder(out)
    for note in rig.notes:
        show(err_console(quiet), f"note: {note}", "yellow")
    with progress_bar(len(places), quiet) as state:
        from spt_jax.cli.frames import (
            as_report,
            made_from,
            print_summary,
            untangle_frames,
            write_meshes,
        )
        from spt_jax.cli.unfinished import UnfinishedRun, manifest_of

        with user_errors():
            manifest = manifest_of(
                "untangle", options | {"meshes": meshes}, rig.body, made_from(motion)
            )
            run = UnfinishedRun(folder, manifest, say=partial(show, err_console(quiet)), anew=anew)
        with run:
            done = untangle_frames(
                rig.body, motion, **options, state=state, run=run, keep_vertices=meshes
            )
            state("writing", done=len(places))
            settings = {"poses": str(path), "character": rig.name, **options}
            report = as_report("untangle", done, settings)
            with user_errors():
                written = write_meshes(folder, done, rig.body.faces, (".glb",)) if meshes else []
                files = write_results(folder, rig, clips, motion, places, done)
                report |= {
                    "meshes": written,
                    "structure": "a rig of glTF",
                    "files": files,
                    "notes": list(rig.notes),
                }
                write_json(folder / "report.json", report)
                run.finish()
    print_summary(done, report, folder, json=json, quiet=quiet)
    return 0


def _character(path: Path, people: str, max_bytes: int | None) -> "RigFile":
    from spt_jax.io.rigs.reading import load_rigs

    rigs = load_rigs(path, dtype=np.float32, max_bytes=max_bytes)
    names = [rig.name for rig in rigs]
    if people == "all" and len(rigs) == 1:
        return rigs[0]
    if people in names:
        return rigs[names.index(people)]
    if people.isdecimal() and int(people) < len(rigs):
        return rigs[int(people)]
    raise ValueError(
        f"people must be one of the characters {', '.join(map(repr, names))}, or its number from "
        f"0, one at a time: got {people!r} for {str(path)!r}."
    )


def motion_of_clips(clips: Sequence["Clip"], frames: str) -> tuple[Motion, list[tuple[int, int]]]:
    """The frames asked for, and of each which clip and which of its frames it is."""
    from spt_jax.cli.motions import select_frames

    rows = [(k, row) for k, clip in enumerate(clips) for row in range(len(clip.times))]
    names = [
        clip.name if clip.frame_rate is None else f"{clip.name}/{row:04d}"
        for clip in clips
        for row in range(len(clip.times))
    ]
    chosen = select_frames(names, frames)
    places = [rows[at] for at in chosen]
    pose, shape, translation = (
        np.stack([getattr(clips[k], field)[row] for k, row in places]).astype(np.float32)
        for field in ("pose", "shape", "translation")
    )
    return Motion([names[at] for at in chosen], pose, shape, translation), places


def write_results(
    folder: Path,
    rig: "RigFile",
    clips: Sequence["Clip"],
    motion: Motion,
    places: Sequence[tuple[int, int]],
    done: Sequence[Frame],
) -> list[str]:
    """The same file with the freed motions as animations, and the motions as .npz and .bvh."""
    from spt_jax.io.rigs.arrays import write_rig_poses
    from spt_jax.io.rigs.bvh import write_bvh

    poses = [clip.pose.copy() for clip in clips]
    for at, (k, row) in enumerate(places):
        # Joints that did not turn stay as the file has them.
        turned = (done[at].pose != motion.pose[at]).any(axis=-1)
        poses[k][row, turned] = done[at].pose[turned]
    freed = [clip.with_pose(pose) for clip, pose in zip(clips, poses, strict=True)]
    suffix = ".vrm" if rig.path.suffix.lower() == ".vrm" else ".glb"
    names = [f"{rig.path.stem}_untangled{suffix}"]
    rig.write(folder / names[0], freed)
    for clip, label in zip(freed, _labels(freed), strict=True):
        arrays = "poses.npz" if len(freed) == 1 else f"poses_{label}.npz"
        write_rig_poses(
            folder / arrays, rig.body, clip.pose, clip.shape, clip.translation, clip.frame_rate
        )
        write_bvh(
            folder / f"{label}.bvh",
            rig.body,
            clip.pose,
            translation=clip.translation,
            frames_per_second=clip.frame_rate or 30.0,
        )
        names += [arrays, f"{label}.bvh"]
    return names


def _labels(clips: Sequence["Clip"]) -> list[str]:
    """The names of motions as parts of files' names, each once."""
    labels = [re.sub(r"[^\w.-]+", "_", clip.name).lstrip(".") or "motion" for clip in clips]
    return [one if labels.count(one) == 1 else f"{one}_{k}" for k, one in enumerate(labels)]
