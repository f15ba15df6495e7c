"""`backend="xla"`: the penalty in pure JAX, without a callback, for accelerators.

`self_intersection_penalty`, `paper_penalty` and `classify_vertices` take it where it is asked for.
By themselves they go to the host, on a GPU or TPU too: there the volume is exact, here it is
sampled (`_query.as_backend`).

What is the same as on the host: the measure, w (w - 1) / 2 for every point of winding number w, so
that each pair of solids counts once where it overlaps, and w_out for every crossing in the gradient
(`overlap.rays.levels`); the rays, one by one, since both cast them through the same lattice in the
world; and which overlaps count: the triangles that pass through each other are all found
(`pair_search`), so groups and folds are decided as there, but for a few pairs of triangles about
`distance` apart at rest, where shortest paths would have to be walked. In float64 values and
gradients agree to 1e-12 and labels are equal. In float32 a ray within rounding of an edge may meet
the other triangle: `python -m benchmarks.device` prints by how much that matters on mocap frames.

What differs:

- Everything is measured by rays; the closed form stays on the host. `rays=None` means 512 along
  the longer side, and overlaps between the rays are not seen. `rule="triangle"` is by rays too.
- Overlaps are connected where their surfaces are, so that on meshes of few large triangles they run
  into each other. Exclusions take two passes over the rays; `rest_surface` also takes a table
  of 50 MB for the embedded body, once.
- An interval is included or excluded as a whole. Where three solids overlap and one of their pairs
  is excluded, which of the other pairs is excluded with it depends on the order in which rays meet
  them.
- More than 16,000 parts (at 512 rays) over one another, or a row of the screen with more crossings
  than the buffers hold, give NaN, and `usage.device_usage` reports it.

What it costs. All arrays have fixed sizes (`settings.Xla`); the screen is worked off in strips of
rows that fit, one direction and, on a CPU, one mesh after the other; `settings.bytes_needed` is an
upper bound of the memory. The benchmark prints the memory, the operations and the bytes of one
strip by XLA's own count, and the time on the device that it runs on; at 512 x 512 three directions
take three or four strips. It has not been measured on a GPU. On a CPU, use the exact backend.

Floating-point numbers are chosen so that float32 will do: places on the screen are whole pixels and
parts of one (`beam`), those in a triangle are relative to its edges (`crossings`), and lengths to
one of their corners (`levels`).
"""

import typing

from spt_jax._lazy import lazy_names as _lazy_names

if typing.TYPE_CHECKING:
    from spt_jax.xla.settings import Xla as Xla
    from spt_jax.xla.usage import device_usage as device_usage

__all__ = ["Xla", "device_usage"]

__getattr__, __dir__ = _lazy_names(
    __name__, {"Xla": "spt_jax.xla.settings", "device_usage": "spt_jax.xla.usage"}
)
