"""Programs are kept by the commands, where the user says, and by nothing else."""

import os
import subprocess
import sys

import pytest

from spt_jax.cli.compilation import SWITCH, cache_folder, keep_programs
from spt_jax.cli.main import main


@pytest.fixture
def bare(monkeypatch, tmp_path):
    for name in list(os.environ):
        if name.startswith(("JAX_COMPILATION", "JAX_PERSISTENT", "SPT_JAX_COMPILATION")):
            monkeypatch.delenv(name)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "caches"))
    monkeypatch.setattr(sys, "platform", "linux")
    # What a test sets itself is undone with the rest.
    for name in ("DIR", "MAX_SIZE"):
        monkeypatch.setenv(f"JAX_COMPILATION_CACHE_{name}", "")
        del os.environ[f"JAX_COMPILATION_CACHE_{name}"]
    monkeypatch.setenv("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", "")
    del os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"]
    return monkeypatch


def test_the_folder_is_the_users_or_the_one_said(bare, tmp_path):
    assert cache_folder() == tmp_path / "caches" / "spt_jax" / "programs"
    keep_programs()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == str(cache_folder())
    assert cache_folder().is_dir()
    bare.setenv("JAX_COMPILATION_CACHE_DIR", "mine")
    bare.setenv(SWITCH, str(tmp_path / "said"))
    keep_programs()
    assert os.environ["JAX_COMPILATION_CACHE_DIR"] == "mine" and not cache_folder().exists()


@pytest.mark.parametrize("off", ["off", "0", "OFF"])
def test_it_can_be_switched_off(bare, off):
    bare.setenv(SWITCH, off)
    keep_programs()
    assert cache_folder() is None and "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_a_folder_that_cannot_be_made_is_no_error(bare, tmp_path):
    (tmp_path / "file").write_text("")
    bare.setenv(SWITCH, str(tmp_path / "file" / "below"))
    keep_programs()
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_a_command_called_from_python_leaves_the_environment_alone(bare, capsys):
    assert main(["check", "no_such_file.obj"]) == 2
    assert "no_such_file.obj" in capsys.readouterr().err
    assert "JAX_COMPILATION_CACHE_DIR" not in os.environ


def test_a_process_keeps_what_it_compiled(bare, tmp_path):
    code = (
        "from spt_jax.cli.compilation import keep_programs; keep_programs(); import jax;"
        "jax.config.update('jax_persistent_cache_min_compile_time_secs', 0);"
        "print(jax.jit(lambda x: x * 2)(1.5))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.stdout.strip() == "3.0", done.stderr
    assert any((tmp_path / "caches" / "spt_jax" / "programs").iterdir())
