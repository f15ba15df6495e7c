"""What the README shows runs and prints what it should."""

import re

from pages import TOP, printed_by, python_blocks

README = (TOP / "README.md").read_text(encoding="utf-8")
RESULTS = (TOP / "benchmarks" / "results.md").read_text(encoding="utf-8")
# For each row of the README's table, in turn, the recorded section that prints its figures.
SECTIONS = (
    *("untangle", "untangle", "untangle-mesh", "exactness", "exactness", "exactness"),
    *("speed", "suite", "folds", "pose_table_1"),
)
FIGURE = r"\d[\d,]*(?:\.\d+)?(?:e-?\d+)?"


def test_the_snippet_frees_the_pose():
    (code,) = python_blocks(README)
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    printed = printed_by(code, "README.md")
    before, after = map(float, re.findall(r"([\d.]+) cm\^3", printed))
    assert before > 300 and after < 0.05 * before


def test_the_commands_are_marked_once():
    for name in ("main-job", "tests"):
        (command,) = re.findall(rf"<!-- {name} -->\n```bash\n(.*?)```", README, re.DOTALL)
        assert command.startswith("python3 -m venv .venv && ")


def test_nothing_was_left_open():
    assert "@@" not in README and "TODO" not in README


def test_pictures_and_pages_exist():
    for target in re.findall(r"\]\((?!https?:)([^)]+)\)", README):
        assert (TOP / target).is_file(), target


def test_it_is_a_screen_and_a_half():
    assert len(README.splitlines()) <= 120


def _figures(text):
    return [figure.replace(",", "") for figure in re.findall(FIGURE, text)]


def test_measured_figures_are_those_that_a_benchmark_recorded():
    table = README[README.index("## Measured") : README.index("## What it does not do")]
    rows = re.findall(r"^\| (.+) \| (.+) \|$", table, re.MULTILINE)
    assert len(rows) == len(SECTIONS)
    for (what, values), section in zip(rows, SECTIONS, strict=True):
        start, end = (RESULTS.index(f"<!-- {section}:{edge} -->") for edge in ("start", "end"))
        recorded = [float(figure) for figure in _figures(RESULTS[start:end])]
        for figure in _figures(values):
            digits = len(figure.split("e")[0].replace(".", "").lstrip("0")) or 1
            assert float(figure) in {float(f"{x:.{digits}g}") for x in recorded}, (what, figure)
