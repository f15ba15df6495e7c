"""viser's server with a guard before its page and its socket."""

import asyncio
import contextlib
import logging
import sys
import threading
from collections.abc import Callable
from http import HTTPStatus
from typing import Any

from spt_jax.view.access import Access

# Of one message from a browser; viser's page sends files in parts of half a MiB.
_LARGEST_MESSAGE = 1 << 20
PATIENCE = 20.0
"""Seconds: a browser is asked as often, and let go when it has not answered for so long."""
_HEADERS = {
    "Cache-Control": "no-store",  # the address has the token
    "Content-Security-Policy": "frame-ancestors 'none'",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}
# Who says something before the handshake may be anybody, and a stranger's garbage is no event.
_LOGGER = logging.getLogger("spt_jax.view.connections")
_LOGGER.addHandler(logging.NullHandler())
_STARTING = threading.Lock()


def import_viser() -> Any:
    """Return viser.

    Raises:
        ImportError: it is not installed; the message names the extra.
    """
    try:
        import viser
    except ImportError as error:
        raise ImportError(
            f'the live view needs viser: got "{error}"; run: pip install "spt_jax[view]"'
        ) from error
    return viser


def start_guarded(viser: Any, access: Access, numeric: str, port: int, patience: float = PATIENCE):
    """Return a viser server that answers nobody whom `access` refuses.

    viser 1.1 has no place for this: it calls `websockets.asyncio.server.serve` by that name, so
    while it starts the name stands for one that puts the guard before viser's own answers. Where a
    later viser should call something else, nothing is served.

    Args:
        viser: the package.
        access: who is let in.
        numeric: the address to serve on, as a number.
        port: the port.
        patience: seconds between two questions to a browser, and for its answer.

    Raises:
        ImportError: this version of viser cannot be guarded.
    """
    import websockets.asyncio.server as sockets

    plain, guarded = sockets.serve, threading.Event()

    def serve(handler: Any, *arguments: Any, **options: Any) -> Any:
        if not getattr(handler, "__module__", "").startswith("viser."):
            return plain(handler, *arguments, **options)
        guarded.set()
        asyncio.get_running_loop().set_exception_handler(_report_from_loop)
        options["process_request"] = _guard(access, options.get("process_request"))
        options["process_response"] = _harden
        options["max_size"] = _LARGEST_MESSAGE
        options["ping_interval"] = options["ping_timeout"] = patience
        options["close_timeout"] = patience / 2
        options["logger"] = _LOGGER
        return plain(_tolerant(handler, patience), *arguments, **options)

    # Without viser's banner: the command says where it serves.
    with _STARTING, contextlib.redirect_stdout(None):
        sockets.serve = serve  # pyright: ignore[reportAttributeAccessIssue]
        try:
            server = viser.ViserServer(host=numeric, port=port, verbose=False)
        finally:
            sockets.serve = plain
    if not guarded.is_set():
        stop_quietly(server)
        raise ImportError(
            f"viser must let the view check who connects: version {viser.__version__} does not; "
            'run: pip install "viser>=1.1,<1.2"'
        )
    _close_share_tunnel(server)
    return server


def drop_removed_nodes(server: Any) -> None:
    """Have viser drop its records of removed nodes, which it does only when a browser connects.

    Every file that is opened leaves ten such records.
    """
    server._run_garbage_collector()


def drop_who_does_not_read(server: Any) -> None:
    """End the connections that have not taken what was sent: stopping would wait for them."""
    for connection in tuple(server._websock_server._live_connections.values()):
        if connection.transport.get_write_buffer_size():
            server.get_event_loop().call_soon_threadsafe(connection.transport.abort)


def stop_quietly(server: Any) -> None:
    """End a viser server without its farewell."""
    with contextlib.redirect_stdout(None):
        server.stop()


def _guard(access: Access, answer: Callable[[Any, Any], Any] | None) -> Callable[[Any, Any], Any]:
    def process_request(connection: Any, request: Any) -> Any:
        reason = access.refusal(request.path, request.headers)
        if reason is not None:
            return connection.respond(HTTPStatus.FORBIDDEN, reason + "\n")
        if request.headers.get("Upgrade", "").lower() != "websocket":
            address = access.redirection(request.path, request.headers)
            if address is not None:
                response = connection.respond(HTTPStatus.SEE_OTHER, "The view is at its address.\n")
                response.headers["Location"] = address
                return response
        return None if answer is None else answer(connection, request)

    return process_request


def _harden(connection: Any, request: Any, response: Any) -> None:
    for name, value in _HEADERS.items():
        response.headers[name] = value


def _tolerant(handler: Callable[[Any], Any], patience: float) -> Callable[[Any], Any]:
    # What is no message ends that browser's connection, not with a traceback.
    async def handle(connection: Any) -> None:
        watch = asyncio.create_task(_drop_if_it_never_reads(connection, patience))
        try:
            await handler(connection)
        except Exception as error:
            _say(f"a browser's connection was closed: {_named(error)}")
            await connection.close(1007, "a message was not understood")
        finally:
            watch.cancel()

    return handle


async def _drop_if_it_never_reads(connection: Any, patience: float) -> None:
    # `websockets` 16 asks such a browser nothing: its ping waits for the message before it to be
    # sent, which is what the browser does not take.
    before = 0
    while True:
        await asyncio.sleep(patience)
        unsent = connection.transport.get_write_buffer_size()
        if unsent and unsent == before:
            connection.transport.abort()
            return
        before = unsent


def _report_from_loop(loop: asyncio.AbstractEventLoop, context: dict[str, Any]) -> None:
    error = context.get("exception")
    _say(f"a browser's message was ignored: {_named(error) if error else context['message']}")


def _named(error: BaseException) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())[:300]


def _say(text: str) -> None:
    print(f"spt-jax view: {text}", file=sys.stderr)


def _close_share_tunnel(server: Any) -> None:
    # Any browser could ask viser to show the view to the whole world through its own service.
    from viser._messages import ShareUrlDisconnect, ShareUrlRequest

    for message in (ShareUrlRequest, ShareUrlDisconnect):
        server._websock_server.unregister_handler(message)
