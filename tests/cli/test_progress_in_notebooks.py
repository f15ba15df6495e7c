"""Progress in a notebook: a bar where it is wanted, and nothing that stays when it is done."""

import nbformat
import pytest
from nbclient import NotebookClient

BAR = """
import warnings
warnings.simplefilter("error")
from spt_jax.cli.terminal import progress_bar
with progress_bar(2, quiet={quiet}) as state:
    state("the first", 1)
"""


def outputs(tmp_path, code):
    """Of one cell in a kernel of its own."""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(code)])
    client = NotebookClient(
        notebook, timeout=60, kernel_name="python3", resources={"metadata": {"path": str(tmp_path)}}
    )
    client.execute()
    return notebook.cells[0].outputs


@pytest.mark.slow
@pytest.mark.parametrize("quiet", [False, True])
def test_a_notebook_shows_a_bar_unless_told_not_to(tmp_path, quiet):
    shown = outputs(tmp_path, BAR.format(quiet=quiet))
    widgets = [o for o in shown if "application/vnd.jupyter.widget-view+json" in o.get("data", {})]
    assert len(widgets) == (0 if quiet else 1), shown
    assert all(o.output_type == "display_data" for o in shown), shown


def test_without_ipywidgets_a_notebook_shows_nothing(tmp_path):
    hidden = "import sys; sys.modules['ipywidgets'] = None\n"
    assert not outputs(tmp_path, hidden + BAR.format(quiet=False))
