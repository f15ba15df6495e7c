"""`spt-jax demo`: real poses that collide, freed, with a picture of before and after."""

import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spt_jax.cli.terminal import (
    CommandError,
    err_console,
    out_console,
    progress_bar,
    show,
    user_errors,
)

if TYPE_CHECKING:
    from spt_jax.cli.frames import Frame

# Chosen by classifying all 1,086 bundled frames at 3 x 256 rays and looking at those with the most
# overlap of each motion: collisions of a body part with a distant one, each of another kind, with
# 40 to 1,250 cm^3 of overlap. The many with over 2,000 cm^3 are bodies folded in half at the hips,
# where little can be seen.
DEMO_FRAMES = (
    "punch/0013",  # a fist in the belly
    "backflip/0022",  # an arm through the shin and thigh
    "spinkick/0060",  # fingers in the forehead, a thigh in the belly
    "jump/0032",  # hands in the knees
    "walk/0005",  # a thumb through the thigh
    "dance_a/0009",  # an upper arm in the chest
    "crawl/0160",  # a thigh in the flank
    "roll/0088",  # a body rolled up
)

_RAYS, _DIRECTIONS, _FOLDS = None, 3, "remove"
_GUTTER = 24  # pixels between the halves of the picture


def demo(out: Path = Path("demo"), frames: int = 4, quiet: bool = False) -> int:
    """Untangle real motion-capture poses of the embedded body, and show them before and after.

    Collisions are removed by changing the pose, then folds by moving the skin. Writes
    before_after.png (triangles in self-intersection are red), a .glb and a .ply of each frame
    before and after, the untangled poses.npz and report.json.

    Args:
        out: folder for the results, made where missing.
        frames: how many frames, 1 to 8.
        quiet: print only errors.
    """
    if not 1 <= frames <= len(DEMO_FRAMES):
        raise CommandError(f"frames must be from 1 to {len(DEMO_FRAMES)}: got {frames}.")
    from spt_jax.files.outputs import ensure_folder, write_json

    with user_errors():
        folder = ensure_folder(out)
    start = time.perf_counter()
    with progress_bar(frames, quiet) as state:
        state("loading the body")
        from spt_jax.body import load_body, load_mocap
        from spt_jax.cli.frames import (
            Motion,
            as_report,
            before_after_table,
            left_out,
            summary,
            untangle_frames,
            write_meshes,
            write_motion,
        )

        body, mocap = load_body(), load_mocap()
        rows = [mocap.names.index(name) for name in DEMO_FRAMES[:frames]]
        pose = np.asarray(body.pose_from_smpl(mocap.pose[rows]))
        motion = Motion(list(DEMO_FRAMES[:frames]), pose)
        done = untangle_frames(
            body, motion, rays=_RAYS, directions=_DIRECTIONS, folds=_FOLDS, state=state
        )
        with user_errors():
            state("writing", done=frames)
            meshes = write_meshes(folder, done, body.faces, (".glb", ".ply"))
            write_motion(folder / "poses.npz", done, motion)
            state("drawing")  # after the rest is safe
            missing = _draw(folder / "before_after.png", done, body.faces)
            settings = {"body": "anny", "rays": _RAYS, "directions": _DIRECTIONS, "folds": _FOLDS}
            report = as_report("demo", done, settings)
            report["seconds"] = round(time.perf_counter() - start, 3)
            report["picture"] = None if missing else "before_after.png"
            report["picture_left_out"] = missing
            report["meshes"] = meshes
            write_json(folder / "report.json", report)
    console = out_console(quiet)
    console.print(before_after_table(done))
    show(console, summary(done))
    show(console, left_out((f.before for f in done), (f.after for f in done)))
    pictures = "" if missing else "before_after.png, "
    show(
        console,
        f"{report['seconds']:.0f} s; in {folder}: {pictures}{len(meshes)} meshes (.glb, .ply), "
        "poses.npz, report.json",
    )
    if missing:
        show(err_console(quiet), f"The picture was left out: {missing}", "yellow")
    return 0


def _draw(path: Path, frames: list["Frame"], faces: Any) -> str | None:
    """Draw the picture, or say why there is none."""
    from spt_jax.files.outputs import atomic_write
    from spt_jax.show import render_strip

    # Two blocks of rows side by side: one above the other is too tall for a page or a screen.
    half = (len(frames) + 1) // 2
    blocks = [block for block in (frames[:half], frames[half:]) if block]
    try:
        pictures = [
            render_strip(
                [[frame.vertices_before, frame.vertices_after] for frame in block],
                faces,
                [[frame.before.labels, frame.after.labels] for frame in block],
                ["before", "after"],
                row_titles=[frame.name for frame in block],
                size=(320, 400),
            )
            for block in blocks
        ]
        from PIL import Image
    except ImportError as error:
        return " ".join(str(error).split())
    height, width, _ = pictures[0].shape
    page = np.full((height, len(pictures) * (width + _GUTTER) - _GUTTER, 3), 255, np.uint8)
    for k, picture in enumerate(pictures):
        x = k * (width + _GUTTER)
        page[: len(picture), x : x + width] = picture
    with atomic_write(path) as temporary:
        Image.fromarray(page).save(temporary, format="PNG", optimize=True)
    return None
