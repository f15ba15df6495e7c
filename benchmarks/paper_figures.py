"""The paper's figures 5, 6 and 7 (sections 4.1 and 4.2) on the embedded body.

`python -m benchmarks.paper_figures [--out DIR] [--record]`: two to four minutes on two cores. What
is run, and why, is in `paper_runs`.
"""

import time
from pathlib import Path

import jax
import numpy as np
import tyro

from benchmarks.common import FIGURES, Table, progress, provenance, record_section
from benchmarks.paper_runs import (
    EVERY,
    NAMES,
    RATE,
    Descent,
    Kinds,
    Pairs,
    Singles,
    as_one_mesh,
    run_pairs,
    run_singles,
)
from spt_jax._labels import classify_vertices
from spt_jax.body import BodyModel, load_body
from spt_jax.files.outputs import ensure_folder
from spt_jax.show import plot_curves, render_strip

SHOWN = (0, 10, 20, 30, 300)
LISTED = (0, 10, 20, 30, 50, 100, 200, 300)


def main(out: Path = FIGURES, record: bool = False) -> None:
    """Reproduce the paper's sections 4.1 and 4.2 and print what came of it.

    Args:
        out: the folder that the pictures go to.
        record: also write the section of results.md.
    """
    began = time.perf_counter()
    out, body = ensure_folder(out), load_body()
    with progress() as bars:
        singles, pairs = run_singles(body, bars), run_pairs(body, bars)
    draw_singles(out, body, singles)
    draw_pairs(out, body, pairs)
    seconds = time.perf_counter() - began
    tables = [*single_tables(singles), rate_table(singles), *pair_tables(pairs)]
    for table in tables:
        table.print()
    print(f"pictures in {out}; {seconds:.0f} s")
    if record:
        body_text = "\n\n".join(
            [
                provenance("python -m benchmarks.paper_figures --record")
                + f" Whole run: {seconds:.0f} s.",
                _METHOD,
                *(table.markdown() for table in tables),
                _reading(singles, pairs),
                "Pictures, in `figures/`: " + ", ".join(f"`{name}`" for name in _PICTURES) + ".",
            ]
        )
        record_section("paper_figures", "Paper, sections 4.1 and 4.2", body_text)


def single_tables(singles: Singles) -> list[Table]:
    """The penalty and the overlap volume of each pose, with Eq. 10 and with Eq. 9."""
    header = ["iteration"]
    for name in (*NAMES, "average"):
        header += [name, "cm3"]
    tables = []
    for key, title in (
        (("Eq. 10", RATE), "Figure 5: unit gradient (Eq. 10), rate 1e-4; value (Eq. 11)"),
        (("Eq. 9", RATE), "Figure 6: not normalized (Eq. 9), rate scaled to the same first step"),
    ):
        rows = []
        for iteration in LISTED:
            values = singles.runs[key].values[iteration]
            volumes = singles.volumes[key][iteration // EVERY]
            pairs = [*zip(values, volumes, strict=True), (values.mean(), volumes.mean())]
            rows.append(
                [str(iteration)] + [text for v, c in pairs for text in (_ratio(v), _cm3(c))]
            )
        tables.append(Table(title, header, rows))
    return tables


def rate_table(singles: Singles) -> Table:
    """How steady each run is over its first 100 steps."""
    header = ["run", "first step, rad", "start", "10", "30", "100", "best", "cm3 at 100"]
    header += ["rises", "largest rise", "pose moved, rad", "root turned, rad"]
    rows = []
    for (name, rate), run in singles.runs.items():
        values = run.values[:101]
        mean = values.mean(axis=1)
        change = np.diff(values, axis=0)
        row = [f"{name}, {_rate_name(name, rate)}", f"{run.first_step:.2g}"]
        row += [_ratio(mean[i]) for i in (0, 10, 30, 100)]
        row += [_ratio(mean.min()), _cm3(singles.volumes[name, rate][10].mean())]
        row += [f"{(change > 0).sum()} of {change.size}", _ratio(change.max())]
        rows.append([*row, f"{_moved(run, 10):.2g}", f"{_root_turn(run, 10):.2g}"])
    title = "Stability: average value of the three poses over 100 steps"
    return Table(title, header, rows)


def pair_tables(pairs: Pairs) -> list[Table]:
    """Self-intersection and intersection of two bodies, every tenth step."""
    header = ["iteration", "within itself", "between the two", "within, cm3", "between, cm3"]
    tables = []
    for name, kinds in pairs.kinds.items():
        rows = []
        for index, kind in enumerate(kinds):
            if index <= 10 or index % 10 == 0:
                rows.append([str(index * EVERY), *_kind_texts(kind)])
        tables.append(Table(f"Figure 7: two bodies as one mesh, {name}", header, rows))
    return tables


_PICTURES = (
    "paper_figure_5.png",
    "paper_figure_6.png",
    "paper_figure_7.png",
    "paper_values.png",
    "paper_rates.png",
    "paper_two_bodies.png",
)


def draw_singles(out: Path, body: BodyModel, singles: Singles) -> None:
    """Figures 5 and 6: one row a pose, one column an iteration; and the curves."""
    faces = np.asarray(body.faces)
    for key, picture in ((("Eq. 10", RATE), _PICTURES[0]), (("Eq. 9", RATE), _PICTURES[1])):
        run = singles.runs[key]
        posed = [body(run.snapshots[i // EVERY]).vertices for i in SHOWN]
        labels = [
            classify_vertices(v, faces, directions=1, rays=512, rule="triangle").labels
            for v in posed
        ]
        titles = [f"{i}: SPT {run.values[i].mean():.4f}" for i in SHOWN]
        render_strip(
            [list(row) for row in np.stack(posed, axis=1)],
            faces,
            [list(row) for row in np.stack(labels, axis=1)],
            titles,
            row_titles=("arm", "legs", "kick"),  # short, or they cover the heads
            size=(220, 290),
            view="front",
            path=out / picture,
        )
    means = {key: run.values.mean(axis=1) for key, run in singles.runs.items()}
    names = {("Eq. 10", RATE): "Eq. 10, rate 1e-4", ("Eq. 9", RATE): "Eq. 9, same first step"}
    names["Eq. 9, same rate", RATE] = "Eq. 9, rate 1e-4"
    ylabel = "SPT (Eq. 11), average of three poses"
    curves = {text: means[key] for key, text in names.items()}
    plot_curves(curves, xlabel="iteration", ylabel=ylabel, path=out / _PICTURES[3])
    curves = {
        f"{name}, {_rate_name(name, rate)}": mean[:101]
        for (name, rate), mean in means.items()
        if name in ("Eq. 10", "Eq. 9")
    }
    plot_curves(curves, xlabel="iteration", ylabel=ylabel, path=out / _PICTURES[4])


def draw_pairs(out: Path, body: BodyModel, pairs: Pairs) -> None:
    """Figure 7, and both kinds of overlap as curves."""
    run = pairs.runs["places fixed"]
    kinds = [pairs.kinds["places fixed"][i // EVERY] for i in SHOWN]
    posed = [as_one_mesh(body, run.snapshots[i // EVERY]) for i in SHOWN]
    render_strip(
        posed,
        pairs.faces,
        [
            classify_vertices(v, pairs.faces, directions=1, rays=512, rule="triangle").labels
            for v in posed
        ],
        [
            f"{i}: within {k.own:.4f}, between {k.between:.4f}"
            for i, k in zip(SHOWN, kinds, strict=True)
        ],
        size=(300, 340),
        view="front",
        path=out / _PICTURES[2],
    )
    curves = {}
    for name, label in (("places fixed", "rate 1e-4"), ("places fixed, rate 1e-3", "rate 1e-3")):
        table = np.array(pairs.kinds[name][:11])
        iterations = np.arange(len(table)) * EVERY
        curves[f"within each body, {label}"] = np.stack([iterations, table[:, 0]], axis=1)
        curves[f"between the bodies, {label}"] = np.stack([iterations, table[:, 1]], axis=1)
    plot_curves(curves, xlabel="iteration", ylabel="share of the vertices", path=out / _PICTURES[5])


_METHOD = """Embedded body, 512 x 512 rays, one direction, shape fixed, plain gradient descent
`pose - rate * gradient` over every pose parameter with the global orientation (paper's rate: 1e-4).
Two starts are frame walk/0010 with an arm, or both legs, turned into the body; the third is a frame
as captured. Values are Eq. 11, a share of the vertices; cm3 is `self_intersection_penalty`'s
overlap volume (three directions), which is a second opinion and drives nothing here. For two
bodies, "within" counts vertices labelled in a body alone and "between" those labelled only in both
together, as shares of all vertices; "between, cm3" is a difference of sampled volumes and can come
out a little below zero; places are the two translations. More than the paper's 30 iterations, and
rates other than 1e-4, go beyond it."""


def _reading(singles: Singles, pairs: Pairs) -> str:
    unit, area = singles.runs["Eq. 10", RATE], singles.runs["Eq. 9", RATE]
    mean = unit.values.mean(axis=1)
    rises = np.mean(np.diff(unit.values, axis=0) > 0)
    free = np.asarray(pairs.runs["places free"].snapshots[-1][1])
    drift = np.linalg.norm(free - np.asarray(pairs.runs["places free"].snapshots[0][1]), axis=-1)
    return f"""What is seen:

- Rate 1e-4 with Eq. 10 lowers the average in 30 iterations from {mean[0]:.4f} to
  {mean[30]:.4f}, and to {mean[300]:.4f} after 300 (best {mean.min():.4f}): it works, but is far
  from done in 30 iterations, and the value was still falling at 300.
- The value is a count and its gradient unit vectors, so it rises at {rises:.0%} of the steps.
  Part of what stays are creases of the skin at the armpits, which walk/0010 has as captured, and
  the whole-triangle rule, which labels every corner of a triangle that is touched.
- Eq. 9 at the rate 1e-4 moves nothing: its vectors are areas, 3e-7 to 1.4e-3 m2 on the body at
  rest (median 4e-5). With its rate scaled to the same first step it comes as low as Eq. 10 or
  lower. It starts worse (the average rises at first) and bends the bodies further: after 300
  iterations the poses have moved by {_moved(area):.2f} rad on average (norm over all joints), with
  Eq. 10 by {_moved(unit):.2f}. At a hundred times the rate it is Eq. 10 that jumps. That
  normalizing makes the descent stable is therefore not reproduced as a rule.
- Neither gradient is in balance: both turn the whole body (last column), which removes no
  self-intersection, and free places drift ({drift.max():.2f} m in 100 iterations), although the
  two bodies overlap by no more than 2 cm3 from iteration 10 on.
- Two bodies: the intersection between them is gone (under 0.1 % of the vertices) in 30
  iterations; the bodies' own overlap falls as in the single case. Once they are apart, the odd
  touch comes back and goes."""


def _moved(run: Descent, snapshot: int = -1) -> float:
    change = np.asarray(run.snapshots[snapshot]) - np.asarray(run.snapshots[0])
    return float(np.linalg.norm(change, axis=(-2, -1)).mean())


def _ratio(value: float) -> str:
    return f"{value:.4f}"


def _cm3(value: float) -> str:
    # Differences of two sampled volumes can come out a little under zero.
    return f"{value:.0f}" if abs(value) >= 10 else f"{value + 0.0:.1f}".replace("-0.0", "0.0")


def _kind_texts(kind: Kinds) -> list[str]:
    return [*map(_ratio, kind[:2]), *map(_cm3, kind[2:])]


def _rate_name(name: str, rate: float) -> str:
    text = f"{rate:.0e}".replace("e-0", "e-")
    return f"step as at {text}" if name == "Eq. 9" else text


def _root_turn(run: Descent, snapshot: int) -> float:
    start, end = (np.asarray(jax.tree.leaves(run.snapshots[i])[0]) for i in (0, snapshot))
    return float(np.linalg.norm(end[:, 0] - start[:, 0], axis=-1).max())


if __name__ == "__main__":
    tyro.cli(main, description=__doc__)
