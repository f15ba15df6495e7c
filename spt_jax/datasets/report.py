"""The report over a data set: one page of HTML that opens without a server or a script."""

import base64
from collections.abc import Callable, Iterable, Mapping, Sequence
from html import escape
from pathlib import PurePosixPath
from typing import Any

from spt_jax.datasets.figures import DEPTH_EDGES, VOLUME_EDGES, file_figures
from spt_jax.datasets.items.store import Store
from spt_jax.datasets.pictures import picture_of, worst
from spt_jax.datasets.summary import Summary, figures_of

Row = Mapping[str, Any]

# Tables of more rows than people read are cut, and say so; manifest.csv has them all.
_MOST_ROWS = 100

_STYLE = """
:root { color-scheme: light dark; --ink: #222; --paper: #fff; --line: #ccc; --before: #d55e00;
  --after: #0072b2; }
@media (prefers-color-scheme: dark) { :root { --ink: #ddd; --paper: #181818; --line: #555; } }
body { font: 15px/1.5 system-ui, sans-serif; color: var(--ink); background: var(--paper);
  max-width: 72em; margin: 2em auto; padding: 0 1em; }
table { border-collapse: collapse; margin: 1em 0; }
th, td { padding: .2em .8em; border-bottom: 1px solid var(--line); text-align: right; }
th:first-child, td:first-child { text-align: left; }
table.text th, table.text td { text-align: left; max-width: 40em; overflow-wrap: anywhere; }
.wide { overflow-x: auto; }
figure { display: inline-block; margin: .5em; vertical-align: top; max-width: 500px; }
figcaption { overflow-wrap: anywhere; font-size: 13px; max-width: 500px; }
img { max-width: 100%; border: 1px solid var(--line); }
svg text { fill: var(--ink); font: 12px system-ui, sans-serif; }
.before { fill: var(--before); } .after { fill: var(--after); }
"""

# Name, unit, factor, digits.
_FIGURES = (
    ("colliding_frames", "", 1.0, 0),
    ("rejected", "", 1.0, 0),
    ("mean_volume", "cm³", 1e6, 3),
    ("largest_volume", "cm³", 1e6, 2),
    ("mean_depth", "mm", 1e3, 2),
    ("largest_depth", "mm", 1e3, 1),
    ("mean_ratio", "%", 100.0, 3),
    ("largest_ratio", "%", 100.0, 2),
    ("mean_second_difference", "mm", 1e3, 3),
    ("largest_second_difference", "mm", 1e3, 2),
)
_SAID = {"rejected": "files with a frame deeper than 5 cm, or more than 10 deeper than 3 cm"}


def page(store: Store, rows: Sequence[Row], summary: Summary, why_not_drawn: str) -> str:
    """The page.

    Args:
        store: where pictures are kept.
        rows: one a file.
        summary: of them.
        why_not_drawn: what stands in place of pictures.
    """
    done = [row for row in rows if row["status"] == "done" and row.get("frames")]
    title = f"spt-jax {summary.task}: {_counted(summary.files, 'file')}"
    parts = [
        f"<h1>{escape(title)}</h1>",
        _overview(summary),
        *([_before_after(summary), *_distributions(done)] if done else []),
        _worst(store, done, why_not_drawn),
        _grouped("By folder", done, _folder_of),
        _people(done),
        _notes(rows),
        _problems(summary),
    ]
    body = "\n".join(part for part in parts if part)
    return (
        f'<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta name="viewport" content="width=device-width">\n<title>{escape(title)}</title>\n'
        f"<style>{_STYLE}</style>\n</head>\n<body>\n{body}\n</body>\n</html>\n"
    )


def _overview(summary: Summary) -> str:
    counts = [f"{count} {status}" for status, count in summary.by_status.items()]
    counts += [f"{summary.missing} not done yet"] if summary.missing else []
    said = f"<p>{_counted(summary.files, 'file')}: {escape(', '.join(counts) or 'none')}."
    if summary.others:
        kinds = ", ".join(f"{count} {kind}" for kind, count in summary.others.items())
        said += f" Left alone, being of another kind: {escape(kinds)}."
    if summary.figures.get("frames"):
        time = _time(summary.figures.get("processor_seconds", 0.0))
        said += f" {_counted(summary.figures['frames'], 'frame')} took {time} of a core."
    return said + "</p>"


def _counted(count: float, word: str) -> str:
    """Such as "1 file" and "1,200 files"."""
    return f"{count:,.0f} {word}{'' if count == 1 else 's'}"


def _time(seconds: float) -> str:
    """In the unit that people would say it in."""
    if seconds >= 5400:
        return f"{seconds / 3600:,.1f} hours"
    return f"{seconds / 60:.1f} minutes" if seconds >= 90 else f"{seconds:.1f} seconds"


def _folder_of(row: Row) -> str:
    folder = str(PurePosixPath(row["name"]).parent)
    return "the data set's own" if folder == "." else folder


def _before_after(summary: Summary) -> str:
    figures, rows = summary.figures, []
    both = "colliding_frames_before" in figures
    for name, unit, factor, digits in _FIGURES:
        keys = (f"{name}_before", f"{name}_after") if both else (name,)
        if all(key in figures for key in keys):
            said = _SAID.get(name, name.replace("_", " ")) + (f", {unit}" if unit else "")
            rows.append([said, *(f"{figures[key] * factor:,.{digits}f}" for key in keys)])
    for name in ("mean_displacement", "largest_displacement"):
        if name in figures:
            said = f"{name.replace('_', ' ')}, mm"
            rows.append([said, "", f"{1e3 * figures[name]:,.2f}"])
    head = ["of all frames", *(("before", "after") if both else ("",))]
    return _table(head, rows)


def _distributions(rows: Sequence[Row]) -> list[str]:
    sums = file_figures([{k: v for k, v in row.items() if k.startswith("frames")} for row in rows])
    found = []
    for name, title, edges, unit, factor in (
        ("frames_by_volume", "Frames by overlap volume", VOLUME_EDGES, "cm³", 1e6),
        ("frames_by_depth", "Frames by depth", DEPTH_EDGES, "mm", 1e3),
    ):
        labels = ["none"]
        for low, high in zip(edges, [*edges[1:], None], strict=True):
            ends = f"{low * factor:g}", "" if high is None else f"{high * factor:g}"
            labels.append(f"{ends[0]}-{ends[1]}" if high is not None else f"> {ends[0]}")
        series = [
            (when, sums[name + when]) for when in ("", "_before", "_after") if name + when in sums
        ]
        found.append(f"<h2>{title}, {unit}</h2>\n{_bars(labels, series)}")
    return found


def _bars(labels: Sequence[str], series: Sequence[tuple[str, Sequence[int]]]) -> str:
    """Bars of how many frames there are, on a scale of logarithms, with the counts."""
    import math

    width, height, left = 80, 150, 10
    wide = (width - 16) / len(series)
    total = max(sum(counts) for _, counts in series)
    full = math.log1p(total)
    drawn = []
    for k, label in enumerate(labels):
        x = left + k * width
        drawn.append(
            f'<text x="{x + width / 2 - 8}" y="{height + 35}" text-anchor="middle">{label}</text>'
        )
        for number, (when, counts) in enumerate(series):
            tall = height * math.log1p(counts[k]) / full if full else 0.0
            at, top = x + number * wide, height + 18 - tall
            kind = "after" if when == "_after" else "before"
            drawn.append(
                f'<rect class="{kind}" x="{at:.1f}" y="{top:.1f}" width="{wide - 2:.1f}" '
                f'height="{tall:.1f}"><title>{counts[k]} frames</title></rect>'
                f'<text x="{at + wide / 2:.1f}" y="{top - 3:.1f}" text-anchor="middle">'
                f"{counts[k] or ''}</text>"
            )
    keys = ""
    if len(series) > 1:
        box = '<svg width="12" height="12"><rect class="{0}" width="12" height="12"/></svg> {0}'
        keys = f"{box.format('before')} {box.format('after')}; "
    legend = f"<p>{keys}heights are logarithms of the counts</p>"
    size = f'width="{left + width * len(labels)}" height="{height + 45}"'
    return f'{legend}<div class="wide"><svg {size} role="img">{"".join(drawn)}</svg></div>'


def _worst(store: Store, rows: Sequence[Row], why_not_drawn: str) -> str:
    found = worst(rows, 10)
    if not found:
        return ""
    when = "_before" if "largest_depth_before" in found[0] else ""
    head = ["file", "person", "frame, from 0", "depth, mm", "volume, cm³"]
    head += ["depth after", "volume after"] if when else []
    table = []
    for row in found:
        cells = [row["name"], row["worst_person"], str(row["worst_frame"])]
        for suffix in (when, "_after") if when else ("",):
            cells.append(f"{1e3 * row[f'largest_depth{suffix}']:.1f}")
            cells.append(f"{1e6 * row[f'largest_volume{suffix}']:,.2f}")
        table.append(cells)
    figures = []
    for row in found:
        path = picture_of(store, row)
        if path.exists():
            content = base64.b64encode(path.read_bytes()).decode()
            name = escape(f"{row['name']}, {row['worst_person']}, frame {row['worst_frame']}")
            figures.append(
                f'<figure><img alt="{name}" src="data:image/png;base64,{content}">'
                f"<figcaption>{name}</figcaption></figure>"
            )
    shown = "\n".join(figures) or f"<p>No pictures: {escape(why_not_drawn)}</p>"
    return f"<h2>The worst {len(found)}</h2>\n{_table(head, table)}\n{shown}"


def _grouped(title: str, rows: Iterable[Row], key: Callable[[Row], str]) -> str:
    groups: dict[str, list[Row]] = {}
    for row in rows:
        groups.setdefault(key(row), []).append(row)
    if not groups:
        return ""
    when = (
        "_before" if any("colliding_frames_before" in r for g in groups.values() for r in g) else ""
    )
    table = []
    for name, group in groups.items():
        sums = figures_of(group)
        cells = [name, str(len(group)), f"{sums['frames']:,.0f}"]
        for suffix in (when, "_after") if when else ("",):
            cells.append(f"{sums[f'colliding_frames{suffix}'] / sums['frames']:.1%}")
            cells.append(f"{1e6 * sums[f'mean_volume{suffix}']:.3f}")
            cells.append(f"{1e3 * sums[f'largest_depth{suffix}']:.1f}")
        table.append((sums[f"colliding_frames{when}"] / sums["frames"], cells))
    table.sort(key=lambda entry: (-entry[0], entry[1][0]))
    columns = ["colliding", "mean volume, cm³", "largest depth, mm"]
    head = [title.removeprefix("By "), "files", "frames", *columns]
    head += [f"{name} after" for name in columns] if when else []
    return f"<h2>{title}</h2>\n{_table(head, [cells for _, cells in table])}"


def _people(rows: Sequence[Row]) -> str:
    """People by name, where files hold several."""
    people = [
        one | {"name": row["name"]}
        for row in rows
        if len(row["people"]) > 1
        for one in row["people"]
    ]
    return _grouped("By person", people, lambda one: f"{one['name']}: {one['person']}")


def _notes(rows: Sequence[Row]) -> str:
    """What was decided about files, and what is in them and not used, each said once."""
    files: dict[str, list[str]] = {}
    for row in rows:
        for note in row.get("notes", ()):
            files.setdefault(note, []).append(row["name"])
    if not files:
        return ""
    table = sorted(([note, str(len(names)), names[0]] for note, names in files.items()), key=_many)
    return f"<h2>Notes</h2>\n{_table(['note', 'files', 'such as'], table, text=True)}"


def _many(cells: Sequence[str]) -> tuple[int, str]:
    return -int(cells[1]), cells[0]


def _problems(summary: Summary) -> str:
    """Failed files first; those that are none of the kind are folded away."""
    parts = []
    bad = [one for one in summary.failures if one["status"] != "unknown"]
    if bad:
        rows = [[one["name"], one["status"], one["message"]] for one in bad]
        parts.append("<h2>Files without a result</h2>")
        parts.append(_table(["file", "status", "why"], rows, text=True))
    unknown = [[one["name"], one["message"]] for one in summary.failures if one not in bad]
    if unknown:
        title = f"{_counted(summary.by_status.get('unknown', 0), 'file')} of another kind"
        table = _table(["file", "why"], unknown, text=True)
        parts.append(f"<details><summary>{title}</summary>\n{table}\n</details>")
    return "\n".join(parts)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]], *, text: bool = False) -> str:
    kind = ' class="text"' if text else ""
    lines = [f'<div class="wide"><table{kind}>']
    lines.append("<tr>" + "".join(f"<th>{escape(cell)}</th>" for cell in head) + "</tr>")
    lines += [
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>"
        for row in rows[:_MOST_ROWS]
    ]
    lines.append("</table></div>")
    if len(rows) > _MOST_ROWS:
        lines.append(f"<p>and {len(rows) - _MOST_ROWS} more, in manifest.csv and summary.json</p>")
    return "\n".join(lines)
