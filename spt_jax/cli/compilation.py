"""Where the commands keep the programs that they have compiled."""

import importlib.util
import os
import sys
from pathlib import Path

#: What says where, or "off"; JAX's own JAX_COMPILATION_CACHE_DIR goes before it.
SWITCH = "SPT_JAX_COMPILATION_CACHE"

# JAX keeps what took a second to compile; the many programs of a fit take less each.
_LEAST_SECONDS = "0.2"
_MOST_BYTES = 2**29  # the oldest go first


def cache_folder() -> Path | None:
    """The folder in which programs are kept; None for nowhere.

    SPT_JAX_COMPILATION_CACHE is a folder, or "off"; without it, `spt_jax/programs` in the user's
    folder of caches: XDG_CACHE_HOME or ~/.cache, ~/Library/Caches on macOS, LOCALAPPDATA on
    Windows.
    """
    said = os.environ.get(SWITCH, "").strip()
    if said.lower() in ("off", "0", "false", "no"):
        return None
    if said:
        return Path(said).expanduser()
    try:
        home = Path.home()
    except RuntimeError:  # a user without a home
        return None
    if sys.platform == "darwin":
        base = home / "Library" / "Caches"
    elif sys.platform == "win32":
        base = Path(os.environ.get("LOCALAPPDATA") or home / "AppData" / "Local")
    else:
        base = Path(os.environ.get("XDG_CACHE_HOME") or home / ".cache")
    return base / "spt_jax" / "programs"


def keep_programs() -> None:
    """Have JAX, which is not imported yet, keep what this process compiles, if it may.

    A folder that cannot be written is no error: then programs are compiled each time.
    """
    folder = cache_folder()
    if folder is None or "JAX_COMPILATION_CACHE_DIR" in os.environ:
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError:
        return
    if not os.access(folder, os.W_OK):
        return
    os.environ["JAX_COMPILATION_CACHE_DIR"] = str(folder)
    os.environ.setdefault("JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS", _LEAST_SECONDS)
    if importlib.util.find_spec("filelock"):  # without it JAX keeps no account of sizes
        os.environ.setdefault("JAX_COMPILATION_CACHE_MAX_SIZE", str(_MOST_BYTES))
