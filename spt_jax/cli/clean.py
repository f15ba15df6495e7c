"""`spt-jax clean`: the motions of a folder, freed of collisions, into another folder."""

from pathlib import Path
from typing import Literal

import tyro

from spt_jax.cli.datasets import RunOptions, over_folder


def clean(
    folder: tyro.conf.Positional[Path],
    out: Path = Path("cleaned"),
    body: str = "anny",
    structure: Literal["input", "amass"] = "input",
    frame_rate: float = 30.0,
    fade: float = 0.02,
    fold_distance: float | None = None,
    margin: float = 0.002,
    feet: float = 20.0,
    pictures: int = 10,
    run: tyro.conf.OmitArgPrefixes[RunOptions] = RunOptions(),
) -> int:
    """Free every motion of a folder from collisions, as smooth as it was, into another folder.

    Takes the pose files that `untangle` takes, in folders of any depth, and writes each to the
    place that it has there, with manifest.jsonl and manifest.csv (a row a file), people.csv,
    summary.json and report.html. Whatever ends the run, the same command goes on; several may work
    on one folder at a time. Files that cannot be read have a row that says why. The exit code is 1
    if there is any, 2 if the folder or the output is at fault.

    Args:
        folder: the data set.
        out: folder for the results, made where missing; nothing is written elsewhere.
        body: "anny", the body that comes with the package, or a body model file.
        structure: of what is written: "input", each file's own, or "amass", an .npz a person.
        frame_rate: of files that say none, in frames a second.
        fade: the time in which a correction comes and goes in a fast motion, in seconds.
        fold_distance: how near to each other, along the skin at rest and in metres, what intersects
            is a fold; not given: as near as the place allows.
        margin: how far apart colliding parts are pushed, in metres.
        feet: how strongly feet that stand are held, against the whole skin.
        pictures: how many of the worst files the report shows.
        run: how the files are worked on.
    """
    from spt_jax.datasets import clean as start

    return over_folder(
        start,
        folder,
        out,
        run,
        body=body,
        structure=structure,
        frame_rate=frame_rate,
        fade=fade,
        fold_distance=fold_distance,
        margin=margin,
        feet=feet,
        pictures=pictures,
    )
