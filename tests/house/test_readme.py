"""What the README shows runs and prints what it should."""

import re

from pages import TOP, printed_by, python_blocks

README = (TOP / "README.md").read_text(encoding="utf-8")


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
