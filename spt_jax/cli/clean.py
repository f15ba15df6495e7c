"""`spt-jax clean`: the motions of a folder, freed of collisions, into another folder."""

from pathlib import Path
from typing import Literal

import tyro

from spt_jax.cli.datasets import over_folder


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
    engine: Literal["local", "ray"] = "local",
    processes: int | Literal["auto"] = "auto",
    shard: str | None = None,
    ray_address: str | None = None,
    ray_cpus: float = 1.0,
    ray_memory: int | None = None,
    ray_retries: int = 3,
    anew: bool = False,
    retry: bool = False,
    verify: bool = False,
    pictures: int = 10,
    max_bytes: int | None = None,
    json: bool = False,
    quiet: bool = False,
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
        fade: the time in which a correction comes and goes, in seconds.
        fold_distance: how near to each other, along the skin at rest and in metres, what intersects
            is a fold; not given: as near as the place allows.
        margin: how far apart colliding parts are pushed, in metres.
        feet: how strongly feet that stand are held, against the whole skin.
        engine: "local", processes of this machine, or "ray", a Ray cluster.
        processes: how many, each of one core and 1 GB; "auto": as many as there is room for.
        shard: i/n with i from 0: one of n parts of the files alone, for job arrays.
        ray_address: of the cluster; not given: RAY_ADDRESS, or one on this machine.
        ray_cpus: cores that each file asks of the cluster.
        ray_memory: bytes that each file asks of the cluster.
        ray_retries: how often a file is tried again whose process or node has ended.
        anew: do what is done again, with whatever settings it was made.
        retry: try files again that failed.
        verify: compare what is done with its hashes, not its sizes alone.
        pictures: how many of the worst files the report shows.
        max_bytes: how large a file may be, and its arrays once unpacked; not given: 1 GiB.
        json: print the summary as JSON in place of the table.
        quiet: print errors alone.
    """
    from spt_jax.datasets import clean as start

    return over_folder(
        start,
        folder,
        out,
        body=body,
        structure=structure,
        frame_rate=frame_rate,
        fade=fade,
        fold_distance=fold_distance,
        margin=margin,
        feet=feet,
        engine=engine,
        processes=processes,
        shard=shard,
        ray=(ray_address, ray_cpus, ray_memory, ray_retries),
        anew=anew,
        retry=retry,
        verify=verify,
        pictures=pictures,
        max_bytes=max_bytes,
        json=json,
        quiet=quiet,
    )
