"""viser records a scene through its server. Here it is a server that never listens: no port of this machine is opened, and nothing is printed."""

import io
from collections.abc import AsyncIterator, Iterator
from contextlib import asynccontextmanager, contextmanager, redirect_stdout
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any
from unittest.mock import patch

if TYPE_CHECKING:
    from viser import ViserServer


@contextmanager
def deaf_server() -> Iterator["ViserServer"]:
    """Yield the server of an empty scene, and stop it at the end."""
    import websockets.asyncio.server
    from viser import ViserServer

    with redirect_stdout(io.StringIO()), patch.object(websockets.asyncio.server, "serve", _nothing):
        server = ViserServer(host="127.0.0.1", port=0, verbose=False)
        try:
            yield server
        finally:
            server.stop()


@asynccontextmanager
async def _nothing(*arguments: Any, **options: Any) -> AsyncIterator[SimpleNamespace]:
    """Stand in for the function of `websockets` that opens a port."""
    del arguments, options
    yield SimpleNamespace(server=SimpleNamespace(sockets=()))
