"""`spt-jax measure`: how much the motions of a folder collide, and nothing changed."""

from pathlib import Path

import tyro

from spt_jax.cli.datasets import RunOptions, over_folder


def measure(
    folder: tyro.conf.Positional[Path],
    out: Path = Path("measured"),
    body: str = "anny",
    fold_distance: float | None = None,
    pictures: int = 10,
    run: tyro.conf.OmitArgPrefixes[RunOptions] = RunOptions(),
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
        pictures: how many of the worst files the report shows.
        run: how the files are worked on.
    """
    from spt_jax.datasets import measure as start

    return over_folder(
        start,
        folder,
        out,
        run,
        body=body,
        fold_distance=fold_distance,
        pictures=pictures,
    )
