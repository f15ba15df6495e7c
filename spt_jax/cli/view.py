"""`spt-jax view`: a body or a mesh in the browser, measured as it is moved."""

import time
from pathlib import Path

import tyro

from spt_jax.cli.terminal import CommandError, err_console, out_console, show, user_errors


def view(
    file: tyro.conf.Positional[Path | None] = None,
    beside: Path | None = None,
    port: int = 8080,
    host: str = "127.0.0.1",
    upload_limit: int = 256,
    max_bytes: int | None = None,
    quiet: bool = False,
) -> int:
    """Look at a body or a mesh in the browser, bend it, and watch it being untangled.

    Joints turn by sliders or by rings in the picture; vertices in self-intersection are colored,
    and volume, ratio and milliseconds are shown as you drag. Ends with Ctrl-C.

    Args:
        file: poses (.npz), a mesh (.ply, .obj, .stl, .off, .glb), a rigged character with its
            animations (.glb, .gltf, .vrm), or an SMPL, SMPL-H or SMPL-X model (.npz, .pkl); the
            body that comes with the package if not given.
        beside: poses of the same people and frames, such as those of the file untangled, which are
            shown beside them and play along.
        port: of the page; the next free one if it is taken.
        host: the address to serve on. Other machines reach a view on 0.0.0.0, without encryption;
            whoever has the address that is printed, with its token, can use it.
        upload_limit: what a file that the browser sends may have, in megabytes.
        max_bytes: what a file and its arrays may take once unpacked, uploads included; not given:
            1 GiB.
        quiet: print the address and errors alone.
    """
    if not 0 < port < 65536:
        raise CommandError(f"port must be from 1 to 65535: got {port}.")
    if upload_limit < 1:
        raise CommandError(f"upload_limit must be at least 1 MB: got {upload_limit}.")
    show(err_console(quiet), "loading the body")
    from spt_jax.view.server import View

    try:
        with user_errors():
            served = View(
                file,
                beside=beside,
                host=host,
                port=port,
                upload_limit=upload_limit,
                max_bytes=max_bytes,
            )
    except ImportError as error:
        raise CommandError(" ".join(str(error).split())) from error
    served.start()
    # Always: nobody gets in without the token.
    show(out_console(), f"open {served.url} in a browser; Ctrl-C ends it")
    if served.access.beyond:
        elsewhere = served.url_elsewhere
        show(err_console(quiet), f"from another machine: {elsewhere}; nothing of it is encrypted")
    try:
        while True:
            time.sleep(3600)
    except KeyboardInterrupt:
        if not served.stop_serving():
            raise  # a search is under way in XLA's threads; the caller knows how to leave them
    return 0
