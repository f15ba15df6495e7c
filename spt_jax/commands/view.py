"""`spt-jax view`: a body or a mesh in the browser, measured as it is moved."""

import time
from pathlib import Path

import tyro

from spt_jax.commands.terminal import CommandError, err_console, out_console, show, user_errors


def view(
    file: tyro.conf.Positional[Path | None] = None,
    port: int = 8080,
    host: str = "127.0.0.1",
    quiet: bool = False,
) -> int:
    """Look at a body or a mesh in the browser, bend it, and watch it come free.

    Joints turn by sliders or by rings in the picture; vertices in self-intersection are coloured,
    and volume, ratio and milliseconds are shown as you drag. Ends with Ctrl-C.

    Args:
        file: poses (.npz), a mesh (.ply, .obj, .stl, .off, .glb), or an SMPL, SMPL-H or SMPL-X
            model (.npz, .pkl); the body that comes with the package if not given.
        port: of the page; the next free one if it is taken.
        host: the address to serve on. Whoever can reach it can use the view: 0.0.0.0 lets the
            whole network in.
        quiet: print errors alone.
    """
    if not 0 < port < 65536:
        raise CommandError(f"port must be from 1 to 65535: got {port}.")
    show(err_console(quiet), "loading the body")
    from spt_jax.view.server import View, import_viser

    try:
        import_viser()
    except ImportError as error:
        raise CommandError(" ".join(str(error).split())) from error
    with user_errors():
        served = View(file, host=host, port=port)
    served.start()
    show(out_console(quiet), f"open {served.url} in a browser; Ctrl-C ends it")
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        if not served.stop_serving():
            raise  # a search is under way in XLA's threads; the caller knows how to leave them
    return 0
