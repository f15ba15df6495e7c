"""The suite: what a call costs, against peers and against itself: `python -m benchmarks`.

Every metric has a name, a unit and a direction. All calls of a block are timed turn about in one
process, so that a machine that slows down slows all of them; what is compared are ratios of
medians. Lists of what is near what are kept from call to call, so no call of ours is given a shape
that was seen before, or one near it: each is larger than the last. `--record` writes the tables,
the plots of growth and baseline.json; `--gate` measures again and fails where a ratio is worse than
the baseline's by more than its tolerance.
"""

import itertools
import json
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from benchmarks.common import FIGURES, Table, progress, provenance, record_section
from benchmarks.growth import Growth, draw_growth, measure_growth
from benchmarks.peers import PEERS, RAYS
from spt_jax import classify_vertices, load_body, load_mocap, self_intersection_penalty
from spt_jax.bridge import callback
from spt_jax.files.outputs import atomic_write

BASELINE = Path(__file__).with_name("baseline.json")
FRAME = "crawl/0092"
DEFAULT, ONE, THREE = "default (exact)", "512 x 512 rays, one direction", "in three directions"
OVERHEAD = "callback alone: to the host and back, nothing measured"
TOLERANCE = 1.35  # medians of ratios on a shared machine differ by a fifth from run to run


@dataclass
class Settings:
    """What is measured, and what becomes of it."""

    repeats: int = 15
    record: bool = False
    """Write the tables into results.md, the plots and the baseline."""
    gate: bool = False
    """Fail where a ratio is worse than the baseline's by more than its tolerance."""
    growth: bool = True
    """Measure growth with bodies, rays and triangles too."""


class Metric(NamedTuple):
    """A number with what it means."""

    name: str
    unit: Literal["ms", "ratio"]
    better: Literal["lower", "higher"]
    value: float
    tolerance: float = TOLERANCE  # of the gate; only ratios are held to it


class Larger:
    """A call of a mesh, or of several, in ever other sizes.

    Args:
        call: what is called.
        mesh: vertices; each call's are larger than the last one's by a sixteenth of these, whatever
            call that was.
    """

    _sizes = itertools.count()

    def __init__(self, call: Callable[[Any], Any], mesh: Any):
        self._call, self._mesh = call, mesh
        self.prepare()

    def prepare(self) -> None:
        """Make the next size."""
        self._given = jax.block_until_ready(self._mesh * (1 + next(Larger._sizes) / 16))

    def __call__(self) -> Any:
        """Call it with the size that was made last."""
        return self._call(self._given)


def timed(calls: Mapping[str, Callable[[], Any]], repeats: int) -> dict[str, np.ndarray]:
    """Milliseconds of each call, turn about, after one of each that is not counted."""
    taken: dict[str, list[float]] = {name: [] for name in calls}
    with progress() as bar:
        task = bar.add_task("calls", total=(repeats + 1) * len(calls))
        for turn in range(repeats + 1):
            for name, call in calls.items():
                callback.clear_results()
                if isinstance(call, Larger):
                    call.prepare()
                start = time.perf_counter()
                jax.block_until_ready(call())
                if turn:
                    taken[name].append(1e3 * (time.perf_counter() - start))
                bar.advance(task)
    return {name: np.array(times) for name, times in taken.items()}


def own_calls(vertices: jax.Array, faces: Any) -> dict[str, Callable[[], Any]]:
    """Value and gradient, and the labels, on one mesh."""

    def penalty(**options):
        call = jax.jit(
            jax.value_and_grad(lambda v: self_intersection_penalty(v, faces, **options).sum())
        )
        return Larger(call, vertices)

    labels = jax.jit(lambda v: classify_vertices(v, faces).labels)
    return {
        DEFAULT: penalty(),
        ONE: penalty(rays=RAYS, directions=1),
        THREE: penalty(rays=RAYS),
        "labels, vertex rule": Larger(labels, vertices),
    }


def against_peers(repeats: int) -> tuple[Table, list[Metric]]:
    """Our calls and everybody's on one posed body."""
    body, mocap = load_body(), load_mocap()
    pose = body.pose_from_smpl(jnp.asarray(mocap.pose[mocap.names.index(FRAME)]))
    vertices = body(pose).vertices
    points, faces = np.asarray(vertices, np.float64), np.asarray(body.faces, np.int64)
    ours = own_calls(vertices, body.faces)
    peers = {p.name: p.make(points, faces) for p in PEERS if p.missing is None}
    crossings = 289_448  # of FRAME with RAYS along -z; Open3D counts as many
    keys = np.random.default_rng(0).integers(0, 2**62, crossings).astype(np.uint64)
    floor = {f"np.sort of {crossings:,} uint64 keys": lambda: np.sort(keys)}
    times = timed(ours | floor | peers, repeats)

    medians = {name: float(np.median(t)) for name, t in times.items()}
    rows, metrics = [], []
    for name, t in times.items():
        low, high = np.percentile(t, [10, 90])
        shares = [f"{medians[name] / medians[ours_name]:.2f}" for ours_name in (DEFAULT, ONE)]
        rows.append((name, f"{low:.1f}", f"{medians[name]:.1f}", f"{high:.1f}", *shares))
        metrics.append(Metric(name, "ms", "lower", medians[name]))
    for name in (*floor, *peers):
        for ours_name in (DEFAULT, ONE):
            ratio = medians[ours_name] / medians[name]
            metrics.append(Metric(f"{ours_name} / {name}", "ratio", "lower", ratio))
    rows += [(p.name, "", "", "", p.missing, "") for p in PEERS if p.missing]
    rows.append(("TUCH, dense winding number (torch)", "", "", "", "not run: see below", ""))
    title = (
        f"Milliseconds on one posed body, {len(vertices)} vertices, {len(faces)} triangles, frame "
        f"{FRAME}; ours are value and gradient under jit"
    )
    header = ("call", "10 %", "median", "90 %", "times our default", "times our one direction")
    return Table(title, header, rows), metrics


def end_to_end(repeats: int) -> tuple[Table, list[Metric]]:
    """A body with its penalty, and what the way to the host costs by itself."""
    body, mocap = load_body(), load_mocap()
    pose = body.pose_from_smpl(jnp.asarray(mocap.pose[mocap.names.index(FRAME)]))
    vertices = body(pose).vertices
    points, faces = np.asarray(vertices, np.float64), np.asarray(body.faces, np.int64)
    frames = np.linspace(0, len(mocap.names) - 1, 16).astype(int)
    batch = body(body.pose_from_smpl(jnp.asarray(mocap.pose[frames]))).vertices
    single = jax.jit(jax.value_and_grad(lambda v: self_intersection_penalty(v, body.faces)))
    many = jax.jit(jax.value_and_grad(lambda v: self_intersection_penalty(v, body.faces).sum()))
    through = jax.jit(
        jax.value_and_grad(
            lambda p, size: self_intersection_penalty(size * body(p).vertices, body.faces)
        )
    )
    alone = jax.jit(jax.value_and_grad(lambda p: jnp.sum(body(p).vertices ** 2)))

    # The penalty's own operands and results, and nothing done in between.
    results = ((), "float32"), (tuple(vertices.shape), "float32")
    empty = jax.jit(lambda v: callback.call_on_host(_nothing, (), results, v, body.faces))

    def on_the_host(points):
        found = host_measurement(points, faces)
        return found.volume, found.gradient("boundary", "vertex")

    for _ in range(8):  # until batches have been worth another process, and that is there
        callback.clear_results()
        jax.block_until_ready(many(batch))
        time.sleep(1.0)
    times = timed(
        {
            "body and its gradient": lambda: alone(pose),
            "body + penalty + gradient": Larger(lambda x: through(pose, x), jnp.ones(())),
            "penalty + gradient": Larger(single, vertices),
            "the same in NumPy alone": Larger(on_the_host, points),
            "16 bodies one by one": Larger(lambda x: [single(v) for v in x], batch),
            "16 bodies, one batch": Larger(many, batch),
        },
        repeats,
    )
    # By itself, call after call: after 20 ms of other work its caches are cold.
    times |= timed({OVERHEAD: lambda: empty(vertices)}, 10 * repeats)
    medians = {name: float(np.median(t)) for name, t in times.items()}
    gain = float(np.median(times["16 bodies one by one"] / times["16 bodies, one batch"]))
    rows = [
        (name, *(f"{x:.2f}" for x in np.percentile(t, [10, 50, 90]))) for name, t in times.items()
    ]
    rows.append(("one by one / one batch (a ratio)", "", f"{gain:.2f}", ""))
    imports = [import_times() for _ in range(max(repeats // 3, 3))]
    with_us = float(np.median([ours / theirs for ours, theirs in imports]))
    for name, t in zip(
        ("import spt_jax", "import jax, optimistix"), np.array(imports).T, strict=True
    ):
        rows.append((name, *(f"{x:.0f}" for x in np.percentile(t, [10, 50, 90]))))
    rows.append(("import spt_jax / import jax, optimistix (a ratio)", "", f"{with_us:.2f}", ""))
    metrics = [Metric(name, "ms", "lower", value) for name, value in medians.items()]
    metrics.append(Metric("16 bodies one by one / one batch", "ratio", "higher", gain))
    metrics.append(Metric("import spt_jax / import jax, optimistix", "ratio", "lower", with_us))
    return Table("End to end, milliseconds", ("call", "10 %", "median", "90 %"), rows), metrics


def import_times() -> tuple[float, float]:
    """Milliseconds that a new process takes to import us, and what we need."""
    taken = []
    # All that its names bring: the package itself imports nothing before it is asked for.
    for code in ("from spt_jax import *", "import jax, optimistix"):
        start = time.perf_counter()
        subprocess.run([sys.executable, "-c", code], check=True)
        taken.append(1e3 * (time.perf_counter() - start))
    return taken[0], taken[1]


def _nothing(vertices, faces, options):
    return np.zeros(()), np.zeros(vertices.shape)


def host_measurement(points, faces):
    """A measurement as the callback asks for it."""
    from spt_jax._query import as_directions
    from spt_jax.overlap.measure import Sampling, measure

    return measure(points, faces, Sampling(None, as_directions(3)))


def worse(metrics: list[Metric], baseline: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """The ratios that are worse than the baseline's by more than their tolerance, in words."""
    said = []
    for metric in metrics:
        before = baseline.get(metric.name)
        if metric.unit != "ratio" or before is None:
            continue
        change = metric.value / before["value"]
        change = change if metric.better == "lower" else 1 / change
        if change > before["tolerance"]:
            said.append(
                f"{metric.name}: {metric.value:.3g}, {change:.2f} times worse than the baseline's "
                f"{before['value']:.3g} (tolerance {before['tolerance']:.2f})"
            )
    return said


_NOTE = """
Peers are timed from the vertices on, trees and all, and none gives a gradient. Open3D and trimesh
list the crossings of the rays that `rays=512, directions=1` casts, and count the same; Open3D on
one thread. libigl's winding numbers are those at the vertices themselves. TUCH's dense winding
number needs torch, which is no dependency of these benchmarks, so it is not run. Open3D needs the
system library libgl1 on a bare Debian.
"""


def main(settings: Settings) -> None:
    """Measure, print, record, and hold against the baseline."""
    if settings.gate and not BASELINE.exists():
        sys.exit(
            f"gate must have {BASELINE.name}: got none; make it with python -m benchmarks --record."
        )
    table, metrics = against_peers(settings.repeats)
    table.print()
    second, more = end_to_end(settings.repeats)
    second.print()
    metrics += more
    grown: Growth | None = None
    if settings.growth:
        grown = measure_growth(max(settings.repeats // 3, 3))
        for one in grown.tables:
            one.print()
    if settings.gate:
        said = worse(metrics, json.loads(BASELINE.read_text(encoding="utf-8"))["metrics"])
        for line in said:
            print(line, file=sys.stderr)
        if said:
            sys.exit(1)
        print(
            f"No ratio is worse than the baseline's by more than its tolerance ({BASELINE.name})."
        )
    if settings.record:
        content = {
            "made_by": "python -m benchmarks --record",
            "metrics": {
                m.name: {k: v for k, v in m._asdict().items() if k != "name"} for m in metrics
            },
        }
        with atomic_write(BASELINE) as temporary:
            temporary.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        command = f"python -m benchmarks --repeats {settings.repeats} --record"
        parts = [provenance(command), table.markdown(), _NOTE.strip(), second.markdown()]
        if grown is not None:
            draw_growth(grown, FIGURES / "growth.png")
            parts += [one.markdown() for one in grown.tables]
            parts.append("![growth](figures/growth.png)")
        record_section("suite", "Against the others, and growth", "\n\n".join(parts))
