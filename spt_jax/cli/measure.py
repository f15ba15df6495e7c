"""`spt-jax measure`: how much the motions of a folder collide, and nothing changed."""

from pathlib import Path
from typing import Literal

import tyro

from spt_jax.cli.datasets import over_folder


def measure(
    folder: tyro.conf.Positional[Path],
    out: Path = Path("measured"),
    body: str = "anny",
    fold_distance: float | None = None,
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
    """Measure how much, how often and how deep the motions of a folder collide.

    Takes the pose files that `untangle` takes, in folders of any depth, and writes figures alone:
    manifest.jsonl and manifest.csv (a row a file), people.csv, summary.json and report.html. Goes
    on, shares its work and ends as `clean` does.

    Args:
        folder: the data set.
        out: folder for the figures, made where missing; nothing is written elsewhere.
        body: "anny", the body that comes with the package, or a body model file.
        fold_distance: how near to each other, along the skin at rest and in metres, what intersects
            is a fold; not given: as near as the place allows.
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
    from spt_jax.datasets import measure as start

    return over_folder(
        start,
        folder,
        out,
        body=body,
        fold_distance=fold_distance,
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
