"""Folders of motions and keypoint files, worked on to the end on one machine or on many."""

import typing

from spt_jax._lazy import lazy_names as _lazy_names

if typing.TYPE_CHECKING:
    from spt_jax.datasets.engines.cluster import Resources as Resources
    from spt_jax.datasets.engines.events import Finished as Finished
    from spt_jax.datasets.engines.events import Progress as Progress
    from spt_jax.datasets.items.work import Task as Task
    from spt_jax.datasets.items.work import UnknownFileError as UnknownFileError
    from spt_jax.datasets.keypoints import fit as fit
    from spt_jax.datasets.motions import clean as clean
    from spt_jax.datasets.motions import measure as measure
    from spt_jax.datasets.runs import run as run
    from spt_jax.datasets.summary import Summary as Summary

__all__ = [
    "Finished",
    "Progress",
    "Resources",
    "Summary",
    "Task",
    "UnknownFileError",
    "clean",
    "fit",
    "measure",
    "run",
]

__getattr__, __dir__ = _lazy_names(
    __name__,
    {
        "Finished": "spt_jax.datasets.engines.events",
        "Progress": "spt_jax.datasets.engines.events",
        "Resources": "spt_jax.datasets.engines.cluster",
        "clean": "spt_jax.datasets.motions",
        "fit": "spt_jax.datasets.keypoints",
        "measure": "spt_jax.datasets.motions",
        "run": "spt_jax.datasets.runs",
        "Summary": "spt_jax.datasets.summary",
        "Task": "spt_jax.datasets.items.work",
        "UnknownFileError": "spt_jax.datasets.items.work",
    },
)
