"""People in DeepLabCut's CSV files, which name their keypoints."""

import csv
from typing import Any, NamedTuple

from spt_jax.keypoints.confidences import shown
from spt_jax.keypoints.entries import Order, Person, as_label, as_points, choose_layout
from spt_jax.keypoints.source import Source

_HEADERS = ("scorer", "individuals", "bodyparts", "coords")
_COORDS = ("x", "y", "likelihood")


class _Columns(NamedTuple):
    """Where the numbers of one individual stand."""

    individual: str | None
    order: Order
    columns: list[tuple[int, int, int | None]]  # of x, y and likelihood of each body part


def from_deeplabcut(source: Source, content: bytes) -> list[Person]:
    """People of a table of DeepLabCut's: one row a frame, one or several individuals.

    The header rows are scorer, individuals where there are several, bodyparts and coords; the first
    column, or the first three, identify the frame. Where there is no likelihood (labeled by hand) a
    point that is there counts in full; one whose cells are empty is missing.

    Raises:
        ValueError: it is no such table; a cell is no number.
    """
    rows = _rows(source, content)
    head: dict[str, list[str]] = {}
    while rows and rows[0] and rows[0][0].strip().lower() in _HEADERS:
        cells = [cell.strip() for cell in rows.pop(0)]
        head[cells[0].lower()] = cells
    if not {"bodyparts", "coords"} <= set(head):
        seen = shown([row[0] for row in rows[:4] if row])
        raise ValueError(
            f"{source.file} must be a table of DeepLabCut's, with rows that begin with scorer, "
            f"bodyparts and coords: got {seen if not head else sorted(head)}."
        )
    found = _individuals(source, head)
    people = []
    for number, cells in enumerate(rows):
        if not any(cell.strip() for cell in cells):
            continue
        first = min(min(columns[:2]) for one in found for columns in one.columns)
        label = _frame(cells[:first], number)
        for one in found:
            where = f"row {number} of {source.file}"
            where += "" if one.individual is None else f", {one.individual}"
            flat = _numbers(where, cells, one.columns)
            layout, flat = choose_layout(where, flat, one.order, (), source.remarks)
            points, confidence = as_points(where, flat, layout, source.remarks)
            people.append(
                Person(points, confidence, layout.name, image=label, id=as_label(one.individual))
            )
    return people


def _rows(source: Source, content: bytes) -> list[list[str]]:
    try:
        text = content.decode("utf-8-sig")
        if text and not text.endswith(("\n", "\r")):
            # A number of which digits are missing is a number, too.
            raise ValueError(
                f"{source.file} must end with the end of a line: got {shown(text[-12:])}; it is "
                "cut, or if it is whole, add one."
            )
        return [row for row in csv.reader(text.splitlines()) if row]
    except (UnicodeDecodeError, csv.Error) as error:
        raise ValueError(f"{source.file} must be a table of text: got {error}.") from error


def _individuals(source: Source, head: dict[str, list[str]]) -> list[_Columns]:
    coords, parts = head["coords"], head["bodyparts"]
    who = head.get("individuals")
    if len(parts) != len(coords) or (who is not None and len(who) != len(coords)):
        raise ValueError(
            f"{source.file} must have header rows of one length: got {len(coords)} coords for "
            f"{len(parts)} bodyparts; the table is cut or damaged."
        )
    places: dict[str | None, dict[str, dict[str, int]]] = {}
    for column, coord in enumerate(coords):
        if coord not in _COORDS:
            continue
        individual = None if who is None else who[column]
        places.setdefault(individual, {}).setdefault(parts[column], {})[coord] = column
    if not places:
        raise ValueError(f"{source.file} must have columns x and y: got {shown(coords)}.")
    found = []
    for individual, named in places.items():
        for part, columns in named.items():
            if not {"x", "y"} <= set(columns):
                raise ValueError(
                    f"{source.file} must have x and y of {part!r}: got {list(columns)}."
                )
        order = source.order or source.named(list(named), individual or "its bodyparts")
        columns = [(one["x"], one["y"], one.get("likelihood")) for one in named.values()]
        found.append(_Columns(individual, order, columns))
    return found


def _numbers(where: str, cells: list[str], columns: list[tuple[int, int, int | None]]) -> list[Any]:
    flat: list[Any] = []
    for triple in columns:
        x, y, trust = (_number(where, cells, column) for column in triple)
        if x is None or y is None or trust is None:
            flat += [0.0, 0.0, 0.0]
        else:
            flat += [x, y, trust]
    return flat


def _number(where: str, cells: list[str], column: int | None) -> float | None:
    """The number of a cell, 1 of a column that is not there; None of an empty one."""
    if column is None:
        return 1.0
    if column >= len(cells):
        raise ValueError(f"{where} must have {column + 1} columns: got {len(cells)}; it is cut.")
    text = cells[column].strip()
    if not text or text.lower() == "nan":
        return None
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{where} must hold numbers: got {shown(text)}.") from None


def _frame(cells: list[str], number: int) -> str | int:
    text = "/".join(cell.strip() for cell in cells if cell.strip())
    try:
        return int(float(text))
    except (ValueError, OverflowError):
        return text or number
