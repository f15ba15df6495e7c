"""Pose files of a folder measured, or freed of collisions, each as a whole motion.

Here are the functions `clean` and `measure`; what they do with each file is in `motion_tasks.py`.
"""

import os
from collections.abc import Callable
from typing import Any, Literal

import numpy as np

from spt_jax.datasets.arguments import as_fold_distance_given
from spt_jax.datasets.motion_tasks import CleanMotions, MeasureMotions
from spt_jax.datasets.runs import run
from spt_jax.datasets.summary import Summary


def clean(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    body: str = "anny",
    structure: Literal["input", "amass"] = "input",
    frame_rate: float = 30.0,
    fade: float = 0.02,
    fold_distance: float | None = None,
    margin: float = 0.002,
    feet: float = 20.0,
    max_bytes: int | None = None,
    pictures: int = 10,
    **how: Any,
) -> Summary:
    """Free every motion of a folder from collisions, as smooth as it was, into another folder.

    Each pose file that `load_poses` reads is freed by `untangle_motion`, in whichever structure it
    is. Whatever ends the run, the same call goes on with what is not done.

    Args:
        folder: the data set; folders in it are looked through too.
        out: where results go, made where missing: each file in the place that it has in `folder`;
            manifest.jsonl and manifest.csv with a row a file, people.csv with one a person,
            summary.json and report.html.
        body: "anny", or the path of a body model.
        structure: "input" writes each file again in its own structure, form and precision, "amass"
            an .npz a person in AMASS' layout.
        frame_rate: of files that say none, in frames a second.
        fade, fold_distance, margin, feet: as in `untangle_motion`; which way is up is inferred from
            how the trunk stands in most frames.
        max_bytes: what a file and its arrays may take; 1 GiB where None.
        pictures: how many of the worst files the report shows before and after.
        how: as in `run`: engine, processes, shard, anew, retry, verify, ray, on_event.

    Returns:
        The summary, as in summary.json. Lengths are in metres, volumes in m^3.

    Raises:
        As `run`.

    Example:
        >>> import pathlib, tempfile
        >>> from spt_jax import load_mocap
        >>> from spt_jax.datasets import clean
        >>> from spt_jax.io import read_poses, write_poses
        >>> mocap = load_mocap()
        >>> k = mocap.names.index("cartwheel/0102")
        >>> with tempfile.TemporaryDirectory() as top:
        ...     folder, out = pathlib.Path(top, "in"), pathlib.Path(top, "out")
        ...     folder.mkdir()
        ...     write_poses(folder / "cartwheel.npz", mocap.pose[k : k + 3], frame_rate=30)
        ...     found = clean(folder, out, processes=0, pictures=0)
        ...     shape = read_poses(out / "cartwheel.npz").pose.shape
        >>> found.by_status, shape
        ({'done': 1}, (3, 22, 3))
        >>> found.figures["colliding_frames_before"], found.figures["colliding_frames_after"]
        (2.0, 0.0)
    """
    if structure not in ("input", "amass"):
        raise ValueError(f'structure must be "input" or "amass": got {structure!r}.')
    _check_positive(frame_rate=frame_rate, fade=fade)
    _check_not_negative(margin=margin, feet=feet, pictures=pictures)
    task = CleanMotions(
        body=os.fspath(body),
        fold_distance=as_fold_distance_given(fold_distance),
        max_bytes=max_bytes,
        pictures=pictures,
        structure=structure,
        frame_rate=frame_rate,
        fade=fade,
        margin=margin,
        feet=feet,
    )
    return run(task, folder, out, **how)


def measure(
    folder: str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    body: str = "anny",
    fold_distance: float | None = None,
    max_bytes: int | None = None,
    pictures: int = 10,
    **how: Any,
) -> Summary:
    """Measure the collisions of every motion of a folder; nothing in it is changed.

    Args:
        folder, body, fold_distance, max_bytes, pictures, how: as in `clean`.
        out: where the figures go: manifest.jsonl, manifest.csv, people.csv, summary.json and
            report.html.

    Returns:
        The summary, as in summary.json.

    Raises:
        As `run`.

    Example:
        >>> import pathlib, tempfile
        >>> from spt_jax import load_mocap
        >>> from spt_jax.datasets import measure
        >>> from spt_jax.io import write_poses
        >>> mocap = load_mocap()
        >>> k = mocap.names.index("cartwheel/0102")
        >>> with tempfile.TemporaryDirectory() as top:
        ...     folder = pathlib.Path(top, "in")
        ...     folder.mkdir()
        ...     write_poses(folder / "cartwheel.npz", mocap.pose[k : k + 3])
        ...     found = measure(folder, pathlib.Path(top, "out"), processes=0, pictures=0)
        >>> found.figures["frames"], found.figures["colliding_frames"]
        (3.0, 2.0)
    """
    _check_not_negative(pictures=pictures)
    task = MeasureMotions(
        body=os.fspath(body),
        fold_distance=as_fold_distance_given(fold_distance),
        max_bytes=max_bytes,
        pictures=pictures,
    )
    return run(task, folder, out, **how)


def _check_positive(**numbers: Any) -> None:
    _check(lambda value: 0 < value < np.inf, "positive", numbers)


def _check_not_negative(**numbers: Any) -> None:
    _check(lambda value: 0 <= value < np.inf, "not negative", numbers)


def _check(good: Callable[[Any], bool], rule: str, numbers: dict[str, Any]) -> None:
    for name, value in numbers.items():
        if isinstance(value, bool) or not isinstance(value, int | float | np.number):
            raise TypeError(f"{name} must be a number: got {value!r}.")
        if not good(value):
            raise ValueError(f"{name} must be finite and {rule}: got {value!r}.")
