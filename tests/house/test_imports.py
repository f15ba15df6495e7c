"""Which module may import which: downwards only, and the measurement of one mesh without JAX."""

import ast
import graphlib
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[2] / "spt_jax"
FILES = {
    ".".join(("spt_jax", *path.relative_to(PACKAGE).with_suffix("").parts)).removesuffix(
        ".__init__"
    ): path
    for path in PACKAGE.rglob("*.py")
    if "data" not in path.relative_to(PACKAGE).parts
}

# Each folder may import those above it in this list, never those below.
FLOORS = (
    "files",
    "overlap",
    "rest",
    "bridge",
    "xla",
    "body",
    "keypoints",
    "io",
    "fit",
    "untangle",
    "show",
    "datasets",
    "view",
    "cli",
)
# Folders that a folder must not import although they precede it.
APART = {"untangle": {"fit"}, "fit": {"untangle"}, "show": {"untangle"}}


def imported(name, tree):
    """Modules of the package that a module imports when it is imported itself."""
    skipped = set()
    for node in ast.walk(tree):
        if isinstance(node, (ast.FunctionDef, ast.Lambda)) or (
            isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test)
        ):
            skipped |= set(ast.walk(node))
    for node in ast.walk(tree):
        if not isinstance(node, ast.ImportFrom) or node in skipped:
            continue
        parts = name.split(".")[: None if FILES[name].name == "__init__.py" else -1]
        base = parts[: len(parts) - node.level + 1] if node.level else []
        whole = ".".join([*base, *([node.module] if node.module else [])])
        for alias in node.names:
            found = f"{whole}.{alias.name}"
            if found in FILES or whole in FILES:
                yield found if found in FILES else whole


GRAPH = {
    name: set(imported(name, ast.parse(path.read_text("utf-8")))) for name, path in FILES.items()
}


def floor(name):
    parts = name.split(".")
    return parts[1] if len(parts) > 1 and parts[1] in FLOORS else None


def test_no_modules_import_each_other_in_a_circle():
    assert len(GRAPH) > 150 and GRAPH["spt_jax._penalty"] > {
        "spt_jax.bridge.callback",
        "spt_jax.overlap.measure",
    }
    list(graphlib.TopologicalSorter(GRAPH).static_order())  # raises CycleError


def folder(name):
    path = FILES[name]
    return path.parent if path.name != "__init__.py" else None  # those only list public names


@pytest.mark.parametrize("top", FLOORS)
def test_no_folder_imports_the_one_that_it_stands_in(top):
    folders = {}
    for name, others in GRAPH.items():
        if floor(name) == top and folder(name):
            found = {folder(other) for other in others if floor(other) == top}
            folders.setdefault(folder(name), set()).update(found - {folder(name), None})
    list(graphlib.TopologicalSorter(folders).static_order())  # raises CycleError


def test_the_measure_of_one_mesh_knows_nothing_of_the_rest():
    for name, others in GRAPH.items():
        if floor(name) == "overlap":
            assert {floor(other) for other in others} <= {"overlap"}, name


@pytest.mark.parametrize("above", FLOORS[1:])
def test_imports_run_downwards(above):
    below = FLOORS[: FLOORS.index(above)]
    for name, others in GRAPH.items():
        where = floor(name)
        if where in below:
            assert not [other for other in others if floor(other) == above], name
        if where == above:
            assert not [other for other in others if floor(other) in APART.get(above, ())], name


def test_the_measure_and_all_that_workers_run_are_imported_without_jax():
    modules = "spt_jax.overlap.host_functions, spt_jax.rest.surface, spt_jax.bridge.worker"
    code = f"import sys, {modules}; print({{'jax', 'optimistix'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "set()", done.stdout + done.stderr
