"""Folders of motions and keypoint files, worked on to the end on one machine or on many."""

import typing

from spt_jax._lazy import lazy_names as _lazy_names

if typing.TYPE_CHECKING:
    from spt_jax.datasets.engines import Finished as Finished
    from spt_jax.datasets.engines import Progress as Progress
    from spt_jax.datasets.engines.cluster import Resources as Resources
    from spt_jax.datasets.motions import clean as clean
    from spt_jax.datasets.motions import measure as measure
    from spt_jax.datasets.run import run as run
    from spt_jax.datasets.summary import Summary as Summary
    from spt_jax.datasets.work import Task as Task
    from spt_jax.datasets.work import UnknownFileError as UnknownFileError

__all__ = [
    "Finished",
    "Progress",
    "Resources",
    "Summary",
    "Task",
    "UnknownFileError",
    "clean",
    "measure",
    "run",
]

__getattr__, __dir__ = _lazy_names(
    __name__,
    {
        "Finished": "spt_jax.datasets.engines",
        "Progress": "spt_jax.datasets.engines",
        "Resources": "spt_jax.datasets.engines.cluster",
        "clean": "spt_jax.datasets.motions",
        "measure": "spt_jax.datasets.motions",
        "run": "spt_jax.datasets.run",
        "Summary": "spt_jax.datasets.summary",
        "Task": "spt_jax.datasets.work",
        "UnknownFileError": "spt_jax.datasets.work",
    },
)
