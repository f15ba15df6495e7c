"""What the runs over folders are told, in the form in which their settings keep it."""

from typing import Any


def as_body_key(body: str) -> str:
    """The body's name, or the hash of its file: where it lies does not matter."""
    if body == "anny":
        return body
    from spt_jax.datasets.items.store import sha256
    from spt_jax.files.limits import as_file

    return f"sha256:{sha256(as_file(body, 'body model'))}"


def as_fold_distance_given(value: Any) -> float | None:
    """A distance along the rest surface, or None, checked before a run begins."""
    from spt_jax._exclusions import as_fold_distance

    return as_fold_distance(value)
