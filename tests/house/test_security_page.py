"""What the security page says is tested is tested."""

import inspect
import re
from pathlib import Path

TOP = Path(__file__).parents[2]
PAGE = (TOP / ".github" / "SECURITY.md").read_text(encoding="utf-8")


def test_every_promise_names_tests_that_exist():
    rows = re.findall(r"^\| (?!promise)[^-].*?[^\\] \| (.*) \|$", PAGE, re.MULTILINE)
    assert len(rows) == PAGE.count("\n| ") - PAGE.count("\n| promise")
    for row in rows:
        groups = re.findall(r"`(tests/[\w/]+\.py)`:((?: `test_\w+`,?)+)", row)
        assert groups, row
        for file, names in groups:
            text = (TOP / file).read_text(encoding="utf-8")
            for name in re.findall(r"test_\w+", names):
                assert f"\ndef {name}(" in text, (file, name)


def test_the_limits_are_those_of_the_code():
    from spt_jax.cli.view import view
    from spt_jax.view.guarded import _LARGEST_MESSAGE, PATIENCE
    from spt_jax.view.uploads import UPLOAD_LIMIT

    assert inspect.signature(view).parameters["upload_limit"].default == UPLOAD_LIMIT
    assert f"at most {UPLOAD_LIMIT} MB (`--upload-limit`)" in PAGE
    assert "a message has at most 1 MiB" in PAGE and _LARGEST_MESSAGE == 2**20
    assert "let go after a minute at most" in PAGE and 2.5 * PATIENCE <= 60
