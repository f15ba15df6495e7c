"""What the README shows runs and prints what it should."""

import contextlib
import io
import re
from pathlib import Path

import jax

README = (Path(__file__).parents[1] / "README.md").read_text(encoding="utf-8")


def printed_by(snippet):
    """What one of the page's Python snippets prints."""
    code = re.findall(r"```python\n(.*?)```", README, re.DOTALL)[snippet]
    assert len([line for line in code.splitlines() if line.strip()]) <= 15
    printed = io.StringIO()
    # A newcomer's JAX promotes dtypes as it always does.
    with jax.numpy_dtype_promotion("standard"), jax.numpy_rank_promotion("allow"):
        with contextlib.redirect_stdout(printed):
            exec(compile(code, "README.md", "exec"), {})
    return printed.getvalue()


def test_the_first_snippet_frees_the_pose():
    before, after = map(float, re.findall(r"([\d.]+) cm\^3", printed_by(0)))
    assert before > 300 and after < 0.05 * before


def test_the_second_snippet_fits_a_body():
    printed = printed_by(1)
    assert printed.startswith("converged {")
    assert 0 < float(re.search(r"'total': ([\d.]+)", printed)[1]) < 100


def test_the_commands_are_marked_once():
    for name in ("main-job", "tests"):
        (command,) = re.findall(rf"<!-- {name} -->\n```bash\n(.*?)```", README, re.DOTALL)
        assert command.startswith("python3 -m venv .venv && ")


def test_nothing_was_left_open():
    assert "@@" not in README and "TODO" not in README


def test_pictures_and_pages_exist():
    for target in re.findall(r"\]\((?!https?:)([^)]+)\)", README):
        assert (Path(__file__).parents[1] / target).is_file(), target
