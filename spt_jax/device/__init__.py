"""`backend="xla"`: the penalty in pure JAX, without a callback, for accelerators.

`self_intersection_penalty`, `paper_penalty` and `classify_vertices` take it, and choose it by
themselves where JAX runs on a GPU or TPU.

What is the same as on the host: the rays, one by one, since both cast them through the same lattice
in the world. In float64 values and gradients agree to 1e-13 and labels are equal (solids, mocap
frames at 128 and 512 rays). In float32 volumes agree to 2e-7, and gradients to 1e-6 of their
largest vector on bodies, 1e-5 on boxes; where a ray within rounding of an edge meets the other
triangle, to 2e-4 at a vertex (1 of 6 frames at 512 rays). Classes by the vertex rule were equal at
all vertices of 13 frames.

What differs:

- Everything is measured by rays; the closed form stays on the host. `rays="auto"` means 512 along
  the longer side: over 40 mocap frames its volume is 0.04 % off the exact one in the median of the
  34 with more than 1 cm^3, 1.6 % at most (1 cm^3), and its gradient 2 % (norm of the difference).
  Overlaps between the rays are not seen: of 0.0001 cm^3 there. `rule="triangle"` is by rays too.
- Folds and groups. On the host the triangles that pass through each other decide for each connected
  overlap; here the ones that rays meet do, and overlaps are connected where their surfaces are or
  one ray shows both. Over 60 mocap frames at 256 rays, `folds` left something in the same 16 as on
  the host, the same classes but for one vertex, and a volume off by 0.5 % in the median of the 16
  and by 0 to 3 % in 13; of two small ones it took 12 % and 31 % more, of one 38 % of 7 cm^3. Two
  people's overlap and their own: within 0.5 % in five scenes. On meshes of few large triangles
  overlaps run into each other. Needs two passes; `folds` also a table of 50 MB for the embedded
  body, once.
- More than 16,000 parts (at 512 rays) over one another, or a row of the screen with more crossings
  than there is room for, give NaN, and `usage.device_usage` tells.

What it costs. All arrays have fixed sizes (`settings.Xla`); the screen is worked off in strips of
rows that fit, one direction and, on a CPU, one mesh after the other. For the embedded body (V =
12,272, F = 24,540) at 512 x 512 in float32 they take 44 MB (float64: 65), of which the formula in
`settings.bytes_needed` is an upper bound. One strip takes 0.11 G operations and moves 0.45 GB, by
XLA's own count; three directions take three or four strips: 0.4 G and 1.6 GB for value and
gradient. On paper, then, the memory of an H200 (4.8 TB/s) would need 0.35 ms; nothing was measured
on a GPU. One call on a busy CPU core takes 170 to 280 ms, five times the host path's rays: that is
what the CPU should use. It compiles in about 7 s there, the vertex rule in 4.

Floating-point numbers are chosen so that float32 will do: places on the screen are whole pixels and
parts of one (`beam`), those in a triangle are relative to its edges (`crossings`), and lengths to
one of their corners (`levels`).
"""
