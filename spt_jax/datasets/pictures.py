"""Pictures of the frames of a data set that collide most."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spt_jax.datasets.items.inventory import Item
from spt_jax.datasets.items.store import Store
from spt_jax.files.outputs import atomic_write, ensure_folder

if TYPE_CHECKING:
    from spt_jax.datasets.motion_tasks import MeasureMotions

Row = Mapping[str, Any]

_SIZE = (240, 320)


def worst(rows: Sequence[Row], count: int) -> list[Row]:
    """The rows of the deepest overlaps, and of the largest among those that are as deep."""

    def rank(row: Row) -> tuple[float, float]:
        when = "_before" if "largest_depth_before" in row else ""
        return row.get(f"largest_depth{when}", 0.0), row.get(f"largest_volume{when}", 0.0)

    found = [row for row in rows if rank(row) > (0.0, 0.0)]
    return sorted(found, key=rank, reverse=True)[:count]


def picture_of(store: Store, row: Row) -> Path:
    """Where the picture of a row is kept; rows that are made anew have another."""
    key = row["finished"] + "".join(row["output_sha256"])
    return store.folder / "pictures" / f"{store.key(row['name'] + key)}.png"


def draw_worst(
    task: "MeasureMotions", store: Store, items: Sequence[Item], rows: Sequence[Row]
) -> str:
    """Draw the worst frames that are not drawn yet; why there are no pictures, if there are none.

    Returns:
        "" where all are there.
    """
    if not task.pictures:
        return "no pictures were asked for"
    wanted = [r for r in worst(rows, task.pictures) if not picture_of(store, r).exists()]
    if not wanted:
        return ""
    known = {item.name: item for item in items}
    try:
        task.prepare()
        ensure_folder(store.folder / "pictures")
        for row in wanted:
            _draw(task, store, known[row["name"]], row)
    except (ImportError, RuntimeError, ValueError, OSError) as error:
        return " ".join(str(error).split())
    return ""


def _draw(task: "MeasureMotions", store: Store, item: Item, row: Row) -> None:
    from spt_jax.show import render_before_after, render_mesh

    people = [one["person"] for one in row["people"]]
    number = people.index(row["worst_person"])
    before, labels = _frame(task, item.path, number, row["worst_frame"])
    faces = np.asarray(task.body_model.faces)
    title = f"{Path(row['name']).name[:28]} {row['worst_frame']}"
    with atomic_write(picture_of(store, row)) as temporary:
        if not row["outputs"]:
            render_mesh(before, faces, labels, size=_SIZE, view="auto", title=title, path=temporary)
            return
        single = len(row["outputs"]) == 1
        output = store.out / row["outputs"][0 if single else number]
        after, freed = _frame(task, output, number if single else 0, row["worst_frame"])
        render_before_after(
            before, after, faces, labels, freed, size=_SIZE, titles=(title, "after"), path=temporary
        )


def _frame(
    task: "MeasureMotions", path: Path, number: int, frame: int
) -> tuple[np.ndarray, np.ndarray]:
    """The vertices of one frame of a file, upright, and their labels."""
    from spt_jax import classify_vertices
    from spt_jax.datasets.tracks import skins
    from spt_jax.io.poses.reading import open_poses

    track = open_poses(path, max_bytes=task.max_bytes).tracks[number]
    posed = task.posed(track, task.body_model)
    pose = posed.pose[frame : frame + 1].copy()
    pose[:, 0] = 0.0
    one = posed._replace(
        pose=pose, shape=posed.shape[frame : frame + 1], translation=np.zeros((1, 3), np.float32)
    )
    (vertices,) = next(skins(task.body_model, one))
    found = classify_vertices(vertices, task.body_model.faces, rest_surface=task.rest_surface)
    return vertices, np.asarray(found.labels)
