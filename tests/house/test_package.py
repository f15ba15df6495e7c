"""What is said of the package's dependencies is the same everywhere it is said."""

import re
import tomllib

from pages import TOP


def test_the_oldest_dependencies_are_those_that_are_admitted():
    project = tomllib.loads((TOP / "pyproject.toml").read_text("utf-8"))["project"]
    extras = project["optional-dependencies"]
    wanted = [*project["dependencies"], *extras["viz"], *extras["view"], *extras["notebooks"]]
    admitted = {r.replace(">=", "==") for r in wanted if not r.startswith("spt-jax")}
    lines = (TOP / ".ci" / "oldest.txt").read_text("utf-8").splitlines()
    assert {line for line in lines if not line.startswith("#")} == admitted


def test_every_workflow_runs_what_ci_runs():
    checks = (TOP / ".github" / "workflows" / "checks.yml").read_text("utf-8")
    assert checks.count("bash .ci/run") == 1
    project = tomllib.loads((TOP / "pyproject.toml").read_text("utf-8"))["project"]
    oldest = project["requires-python"].removeprefix(">=")
    assert re.findall(r'python: "([\d.]+)"', checks)[0] == oldest


def test_the_citation_has_the_version():
    project = tomllib.loads((TOP / "pyproject.toml").read_text("utf-8"))["project"]
    citation = (TOP / "CITATION.cff").read_text("utf-8")
    assert f"\nversion: {project['version']}\n" in citation
