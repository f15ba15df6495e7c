"""What the package keeps between calls, given back."""

import ctypes
import gc
import sys

import equinox as eqx
import jax

from spt_jax.bridge import on_host
from spt_jax.bridge.bounded_jit import BoundedJit
from spt_jax.overlap.host_curvature import Curvatures
from spt_jax.overlap.triangles.faces_cache import FacesCache


def clear_caches() -> None:
    """Give back what is kept between calls: memory, compiled programs, and other processes.

    What is kept is bounded whatever changes from call to call: the results of the last meshes
    (`config.result_cache_bytes`, 64 MB), what follows from the last lists of faces, tables of the
    last rest surfaces (50 MB each, at most four), the last eight meshes of `second_order=True` (10
    MB each for a body), the last 64 compiled calls of `backend="xla"`, and the processes that share
    batches (100 MB each). This gives all of it back, together with JAX's own compiled programs, as
    `jax.clear_caches()` does. Everything is made again when it is next asked for: nothing that is
    returned changes.

    Calls that are under way in other threads are not disturbed.

    Example:
        >>> import spt_jax
        >>> spt_jax.clear_caches()
    """
    on_host.release()
    # A cache that is added later is found too, and none has to be listed twice.
    for name, module in list(sys.modules.items()):
        if name.partition(".")[0] != __package__:
            continue
        for value in list(vars(module).values()):
            if isinstance(value, (BoundedJit, FacesCache, Curvatures)):
                value.clear()
            elif hasattr(value, "cache_clear") and hasattr(value, "cache_info"):
                value.cache_clear()
    eqx.clear_caches()  # its own alone, which refer to programs of JAX
    jax.clear_caches()
    gc.collect()
    _give_pages_back()


def _give_pages_back() -> None:
    """Where the allocator is glibc's, hand its free pages to the system."""
    if sys.platform == "linux":
        trim = getattr(ctypes.CDLL(None), "malloc_trim", None)
        if trim is not None:
            trim(0)
