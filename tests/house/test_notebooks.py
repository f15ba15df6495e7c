"""What is stored in notebooks/: executed from top to bottom, without errors, small, and listed."""

import re
from pathlib import Path

import nbformat
import pytest

FOLDER = Path(__file__).parents[2] / "notebooks"
FILES = sorted(FOLDER.glob("*.ipynb"))
MOST_BYTES = 1_500_000
# What a path of somebody's machine looks like, in outputs and in sources.
MACHINE_PATH = re.compile(
    r"(?<![\w.:/])/(?:home|root|tmp|Users|work|usr|opt|var|private)/|[A-Z]:\\"
)

notebooks = pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)


def read(file):
    return nbformat.read(file, as_version=4)


def code_cells(file):
    return [cell for cell in read(file).cells if cell.cell_type == "code"]


def texts(output):
    """All that an output says, pictures left out."""
    yield output.get("text", "")
    for kind, content in output.get("data", {}).items():
        if not kind.startswith("image/"):
            yield str(content)


def test_they_are_numbered_without_gaps():
    numbers = [int(re.match(r"(\d+)_[a-z_]+\.ipynb$", file.name)[1]) for file in FILES]
    assert numbers == list(range(1, len(FILES) + 1)) and len(FILES) >= 6


@notebooks
def test_they_are_valid_and_run_in_any_kernel_of_python_3(file):
    notebook = read(file)
    nbformat.validate(notebook)
    assert notebook.metadata.kernelspec.name == "python3"


@notebooks
def test_they_are_executed_from_top_to_bottom(file):
    counts = [cell.execution_count for cell in code_cells(file)]
    assert counts == list(range(1, len(counts) + 1))


@notebooks
def test_no_cell_failed_or_warned(file):
    for cell in code_cells(file):
        for output in cell.outputs:
            assert output.output_type != "error", output
            assert output.get("name") != "stderr", output.text


@notebooks
def test_they_name_no_path_of_a_machine(file):
    for cell in read(file).cells:
        for text in (cell.source, *(t for o in cell.get("outputs", []) for t in texts(o))):
            assert not MACHINE_PATH.search(text), text


@notebooks
def test_they_hold_no_times_of_execution(file):
    notebook = read(file)
    for part in (notebook, *notebook.cells):
        assert not {"execution", "collapsed", "widgets"} & set(part.metadata)


@notebooks
def test_they_are_small(file):
    assert file.stat().st_size < MOST_BYTES


@notebooks
def test_they_begin_with_a_claim_and_end_with_what_they_showed_in_numbers(file):
    cells = read(file).cells
    assert cells[0].source.startswith(f"# {file.name.split('_')[0]}. ")
    assert "**What this notebook claims**" in cells[0].source
    said = [
        k for k, cell in enumerate(cells) if cell.source.rstrip().endswith("What this showed**")
    ]
    assert len(said) == 1 and cells[said[0]].cell_type == "markdown"
    shown = cells[said[0] + 1]
    assert shown.cell_type == "code"
    assert re.search(r"\d", "".join(t for output in shown.outputs for t in texts(output)))
    assert len(cells) <= said[0] + 3, "only where to go next may follow"


@notebooks
def test_links_lead_somewhere(file):
    for cell in read(file).cells:
        if cell.cell_type == "markdown":
            for target in re.findall(r"\]\(([^)#]+)\)", cell.source):
                assert target.startswith("https://") or (FOLDER / target).exists(), target


def test_the_page_lists_each_of_them_once():
    listed = re.findall(r"\]\(([^)]+)\.ipynb\)", (FOLDER / "README.md").read_text("utf-8"))
    assert listed == [file.stem for file in FILES]


@pytest.mark.parametrize("text", ["/home/me/x", "in /tmp/abc", "C:\\Users", '"/work/main"'])
def test_paths_of_machines_are_known(text):
    assert MACHINE_PATH.search(text)


@pytest.mark.parametrize("text", ["https://a.org/home/x", "../benchmarks/results.md", "m/s", "1/2"])
def test_other_slashes_are_no_paths(text):
    assert not MACHINE_PATH.search(text)
