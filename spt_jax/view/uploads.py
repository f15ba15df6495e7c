"""Files that a browser sends: no more than is allowed, and no more than was announced."""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

from spt_jax.view.files import label_of

UPLOAD_LIMIT = 256
"""Megabytes, unless the user says otherwise: SMPL-X as .npz has 170."""
_MEGABYTE = 1_000_000
_SECONDS_SHOWN = 15.0


@dataclass
class _Upload:
    button: str | None
    transfer: str
    label: str
    size: int
    parts: int = 0
    content: bytearray = field(default_factory=bytearray)


class Uploads:
    """Takes files from browsers in place of viser, which takes them at any size.

    viser also keeps what it acknowledged for as long as it runs, and believes the number of parts.
    Here parts come in their order, as viser's page sends them; one file a browser at a time; all
    that is under way together keeps to the limit; and nothing is kept of a browser that leaves. All
    of it runs on viser's event loop.

    Args:
        server: viser's, whose own handlers are taken out.
        limit: megabytes (10^6 bytes).
        take: take(name, content) is called with each file that arrived whole.
    """

    def __init__(self, server: Any, limit: int, take: Callable[[str, bytes], None]):
        from viser._messages import FileTransferPart, FileTransferStartUpload

        self._server, self._limit, self._take = server, limit, take
        self._under_way: dict[int, _Upload] = {}
        handlers = ((FileTransferStartUpload, self._start), (FileTransferPart, self._part))
        for message, handler in handlers:
            server._websock_server.unregister_handler(message)
            server._websock_server.register_handler(message, handler)
        server._websock_server.on_client_disconnect(self._leave)

    def _start(self, client: int, message: Any) -> None:
        self._under_way.pop(client, None)
        label, size = label_of(message.filename), message.size_bytes
        begun = sum(upload.size for upload in self._under_way.values())
        if not 0 <= size <= self._limit * _MEGABYTE:
            needed = math.ceil(max(size, 0) / _MEGABYTE)
            self._refuse(
                client,
                message,
                f"file must have at most {self._limit} MB: got {label!r} with {needed} MB; start "
                f"the view with --upload-limit {needed}, or with the file: spt-jax view FILE",
            )
        elif begun + size > self._limit * _MEGABYTE:
            self._refuse(
                client,
                message,
                f"files must have at most {self._limit} MB in all at a time: got {label!r} while "
                "another browser sends one; try again when that has arrived",
            )
        else:
            upload = _Upload(message.source_component_uuid, message.transfer_uuid, label, size)
            self._under_way[client] = upload
            self._go_on(client, upload)

    def _part(self, client: int, message: Any) -> None:
        upload = self._under_way.get(client)
        if upload is None or upload.transfer != message.transfer_uuid:
            return  # of a file that was refused: its parts come all the same
        content = message.content
        fits = isinstance(content, bytes) and 0 < len(content) <= upload.size - len(upload.content)
        if not fits or message.part_index != upload.parts:
            del self._under_way[client]
            self._refuse(
                client,
                message,
                f"file must arrive in order and as long as announced: got part "
                f"{message.part_index} of {upload.label!r} after {upload.parts} parts and "
                f"{len(upload.content)} of {upload.size} bytes; send it again",
            )
            return
        upload.content += content
        upload.parts += 1
        self._go_on(client, upload)

    def _go_on(self, client: int, upload: _Upload) -> None:
        self._acknowledge(client, upload.button, upload.transfer, len(upload.content), upload.size)
        if len(upload.content) == upload.size:
            del self._under_way[client]
            self._take(upload.label, bytes(upload.content))

    def _leave(self, connection: Any) -> None:
        self._under_way.pop(connection.client_id, None)

    def _refuse(self, client: int, message: Any, reason: str) -> None:
        from viser._messages import RemoveNotificationMessage

        button, transfer = message.source_component_uuid, message.transfer_uuid
        self._acknowledge(client, button, transfer, 0, 0)  # its button works again
        self._send(client, RemoveNotificationMessage(f"upload-{transfer}"))
        handle = self._server.get_clients().get(client)
        if handle is not None:
            handle.add_notification(
                "That file is not opened",
                reason,
                auto_close_seconds=_SECONDS_SHOWN,
                color="red",
            )

    def _acknowledge(
        self, client: int, button: str | None, transfer: str, arrived: int, size: int
    ) -> None:
        from viser._messages import FileTransferPartAck

        # viser sends it to every browser, and again to each that comes later.
        self._send(client, FileTransferPartAck(button, transfer, arrived, size))

    def _send(self, client: int, message: Any) -> None:
        handle = self._server.get_clients().get(client)
        if handle is not None:
            handle._websock_connection.queue_message(message)
