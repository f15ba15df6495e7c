"""The pages of docs/: what they show runs, what they name exists, what they claim is recorded.

`mkdocs build --strict`, which `.ci/run` calls, checks their links.
"""

import importlib
import inspect
import re

import numpy as np
import pytest
import trimesh
from helpers_body import synthetic_smpl
from pages import TOP, printed_by, python_blocks

import spt_jax

DOCS = TOP / "docs"
PAGES = {str(page.relative_to(DOCS)): page.read_text("utf-8") for page in DOCS.rglob("*.md")}
#: Those whose programs take less than five seconds of a core.
QUICK = {"contributing.md", "recipes/pose-files.md", "recipes/smplx.md", "recipes/body-models.md"}
#: What they show is tested elsewhere, and they untangle bodies for many seconds: every night.
NIGHTLY = {"recipes/contact.md", "recipes/through.md"}


def _marks(name):
    if name in NIGHTLY:
        return pytest.mark.long
    return () if name in QUICK else pytest.mark.slow


SHOWN = [
    pytest.param(name, marks=_marks(name))
    for name, text in sorted(PAGES.items())
    if python_blocks(text)
]


def numbers(pattern, printed):
    return [float(number) for number in re.findall(pattern, printed)]


def freed_by_the_first_program(printed):
    before, after = numbers(r"([\d.]+) cm\^3", printed)
    assert "volume 0.224, its change along x -0.560\n2 of 16 vertices" in printed
    assert before > 300 and after < 0.05 * before


def the_worm_is_free(printed):
    before, after = numbers(r"(\d+) (?:intersecting|after)", printed)
    assert before > 10 and after == 0 and "free" in printed


def what_is_between_and_within_adds_up(printed):
    everything, between, within, left = numbers(r"([\d.]+) (?:cm\^3|between|within)", printed)
    assert abs(everything - between - within) < 0.2 and between > 100
    assert left < 0.1 * between


def fits(printed):
    assert printed.startswith("converged {")
    assert 0 < numbers(r"'total': ([\d.]+)", printed)[0] < 100


def the_network_learns_to_collide_less(printed):
    off = numbers(r"([\d.]+) rad", printed)
    task, both = numbers(r"([\d.]+) cm", printed)
    assert off[0] < 0.1 and off[1] < 2
    assert task > 100 and both < 0.1 * task


def the_worst_sample_is_corrected(printed):
    before, after = numbers(r"(\d+) (?:before|after)", printed)
    assert before > 0 and after == 0
    assert 0 < numbers(r"(\d+) of 8 have no collision", printed)[0] < 8


def newton_finds_the_balance(printed):
    steps, slope = re.search(r"(\d+) steps, slope (\S+)", printed).groups()
    assert 0 < int(steps) < 10 and float(slope) < 1e-4
    assert numbers(r"differences by ([\d.]+)", printed)[0] < 0.02


def contact_is_kept(printed):
    assert printed.count("between them to 0.05") == 2
    let_go, kept = numbers(r"collision-free, (\d+) mm apart", printed)
    assert let_go > 50 and kept < 5


def the_arm_is_out(printed):
    before, after = numbers(r"(\d+) (?:cm\^3 before|after)", printed)
    assert before > 500 and after == 0 and "collision-free" in printed


def the_robot_is_free(printed):
    before, after = map(float, re.search(r"(\d+) cm\^3, then ([\d.]+)", printed).groups())
    assert before > 1000 and after < 0.01 * before
    assert numbers(r"(\d+) cm\^3 of the leg", printed)[0] > 500


def the_device_samples(printed):
    exact, host, device = numbers(r"(0\.\d+)", printed)
    assert 0 < abs(host / exact - 1) < 0.05 and abs(device / host - 1) < 1e-3
    assert "returns to the host: False" in printed


def energy_is_conserved(printed):
    (accepted,) = numbers(r"(\d+)% accepted", printed)
    (error,) = numbers(r"energy off by ([\d.]+)", printed)
    assert accepted >= 70 and error < 0.5


def prints(*words):
    def said(printed):
        for word in words:
            assert word in printed

    return said


#: What is expected of a page's output. A page that shows Python and is missing here fails.
EXPECTED = {
    "start.md": freed_by_the_first_program,
    "contributing.md": prints(
        "(6, 3)", "4.0", "[[0 1 2]]", "0.112 of the solid, -0.28 a unit along x"
    ),
    "recipes/own-body.md": the_worm_is_free,
    "recipes/open-meshes.md": prints(
        "2 holes", "litres", "cm^2 inside", "pushed to -x", "intersection-free", "not move: True"
    ),
    "recipes/smplx.md": prints("cm^3 of collisions", "intersecting pairs"),
    "recipes/body-models.md": prints(
        " with adapt", "body_pose", "collision-free", "fit for the penalty", "after"
    ),
    "recipes/rigs.md": prints("52 joints, ('Cartwheel',)", "0 after", "('Cartwheel untangled',)"),
    "recipes/pose-files.md": prints("walk (5, 22, 3) 120.0 female", "5 frames of 52 joints"),
    "recipes/datasets.md": prints("{'done': 2} {'.txt': 1}", "of 6 frames collide, 0 after"),
    "recipes/motions.md": prints(
        "after: 0", "leave it out: False False", "'motion.glb'", "cm^3", "mm deep", "in contact"
    ),
    "recipes/people.md": what_is_between_and_within_adds_up,
    "recipes/keypoints.md": fits,
    "recipes/training-loss.md": the_network_learns_to_collide_less,
    "recipes/generator.md": the_worst_sample_is_corrected,
    "recipes/hmc.md": energy_is_conserved,
    "recipes/second-order.md": newton_finds_the_balance,
    "recipes/contact.md": contact_is_kept,
    "recipes/through.md": the_arm_is_out,
    "recipes/robots.md": the_robot_is_free,
    "recipes/accelerator.md": the_device_samples,
}


@pytest.fixture
def folder_with_bodies(tmp_path, monkeypatch, rng):
    """Files that may not be passed on, made small: spheres with SMPL's and SMPL-X's skeletons."""
    ball = trimesh.creation.icosphere(subdivisions=2)
    for name, joints in (("SMPL_NEUTRAL.npz", 24), ("SMPLX_NEUTRAL.npz", 55)):
        made = synthetic_smpl(rng, joints=joints, vertices=len(ball.vertices))
        made |= {"v_template": ball.vertices, "f": ball.faces, "posedirs": 0 * made["posedirs"]}
        np.savez(tmp_path / name, **made)
    monkeypatch.chdir(tmp_path)


@pytest.mark.usefixtures("folder_with_bodies")
@pytest.mark.parametrize("name", SHOWN)
def test_what_a_page_shows_runs(name):
    names: dict = {}
    printed = "".join(printed_by(code, name, names) for code in python_blocks(PAGES[name]))
    EXPECTED[name](printed)


@pytest.mark.parametrize("name", sorted(PAGES))
def test_files_of_the_repository_that_a_page_names_exist(name):
    pattern = r"`((?:spt_jax|tests|benchmarks|notebooks|docs|\.ci|\.github)/[\w./-]*)`"
    for path in re.findall(pattern, PAGES[name]):
        if "NAME" not in path and "..." not in path:
            assert (TOP / path).exists(), path


def test_every_public_name_is_on_one_page_of_the_api():
    listed = [
        name
        for page, text in PAGES.items()
        if page.startswith("api/")
        for name in re.findall(r"^::: ([\w.]+)$", text, re.MULTILINE)
    ]
    assert len(listed) == len(set(listed))
    for name in listed:
        module, _, last = name.rpartition(".")
        assert hasattr(importlib.import_module(module), last), name
    for name in dir(spt_jax):
        value = getattr(spt_jax, name)
        kind = f"{type(value).__module__}.{type(value).__qualname__}"  # of a single object
        if name[0] != "_" and not inspect.ismodule(value):
            assert f"spt_jax.{name}" in listed or kind in listed, name


def test_records_that_a_page_shows_are_there():
    results = (TOP / "benchmarks" / "results.md").read_text("utf-8")
    shown = [
        found
        for text in PAGES.values()
        for found in re.findall(r"<!-- results: ([\w-]+)(?: \| (.+?))? -->", text)
    ]
    assert len(shown) > 10
    for section, caption in shown:
        start, end = (results.index(f"<!-- {section}:{edge} -->") for edge in ("start", "end"))
        assert results[start:end].count(f"\n**{caption}") >= 1, (section, caption)


def test_pictures_beside_the_pages_are_small():
    for picture in (*DOCS.rglob("*.png"), *DOCS.rglob("*.jpg"), *DOCS.rglob("*.svg")):
        assert picture.stat().st_size < 300_000, picture
