"""The server of the page: its files by GET, everything else by one WebSocket for each browser.

The server accepts JSON texts of a few kilobytes and no files. It refuses pages of other origins, and names of other hosts where
it listens for this machine alone.
"""

from __future__ import annotations

import asyncio
import contextlib
import http
import logging
import secrets
import threading
from collections.abc import Callable
from concurrent.futures import CancelledError, Future
from importlib import resources
from typing import Any
from urllib.parse import parse_qs, urlsplit

from bokehguide.errors import BokehguideError
from bokehguide.view.address import is_loopback, unusable
from bokehguide.view.messages import encoded, parsed
from bokehguide.view.session import FREE, Exhibit, Message

log = logging.getLogger(__name__)

TYPES = {".html": "text/html", ".css": "text/css", ".js": "text/javascript", ".svg": "image/svg+xml"}
MAX_REQUEST = 1 << 14
"""Bytes of the longest request of a page."""
MAX_BROWSERS = 16
SILENCE = 60.0
"""Seconds without a sign of life after which a browser counts as gone."""
POLICY = "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob:; connect-src 'self'; base-uri 'none'"


def require_websockets() -> None:
    """Raise BokehguideError where the package `websockets` is not installed."""
    try:
        import websockets.asyncio.server  # noqa: F401
    except ImportError as error:
        raise BokehguideError(f"view: needs websockets ({error}); pip install 'bokehguide[view]'") from None


class _Browser:
    """A connected browser: the messages that wait for it, the latest of each kind."""

    def __init__(self) -> None:
        self.waiting: dict[str, Message] = {}
        self.ready = asyncio.Event()

    def put(self, message: Message) -> None:
        """Let a message wait, in place of an older one of its kind."""
        self.waiting.pop(message.kind, None)
        self.waiting[message.kind] = message
        self.ready.set()


class ViewServer:
    """Shows an `Exhibit` to browsers, on a thread of its own. The browser that has been connected longest steers.

    host, port: to listen on; 0 is any free port. A host that is not this machine's own gets a token in the address.
    """

    def __init__(self, shown: Exhibit, host: str = "127.0.0.1", port: int = 0):
        self.shown, self.host, self._port = shown, host, port
        self.token = None if is_loopback(host) else secrets.token_urlsafe(16)
        self.closed = False
        self._browsers: list[_Browser] = []
        self._loop = asyncio.new_event_loop()
        self._ready: Future[int] = Future()
        self._end = asyncio.Event()
        self._thread = threading.Thread(target=self._run, name="view server", daemon=True)

    def start(self) -> None:
        """Begin to listen. Raises BokehguideError for an address that cannot be used."""
        self._thread.start()
        try:
            self._port = self._ready.result()
        except OSError as error:
            raise unusable(self.host, self._port, error) from None
        self.shown.start(self.send)

    @property
    def address(self) -> str:
        """The address of the page."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return f"http://{host}:{self._port}/" + (f"?token={self.token}" if self.token else "")

    def close(self) -> None:
        """End the connections, the thread, and the work of the exhibit. A second call does nothing."""
        if self.closed:
            return
        self.closed = True
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join()
        self.shown.close()

    def send(self, message: Message) -> None:
        """Send a message to all browsers; any thread may call."""
        self._call(self._broadcast, message)

    def _call(self, function: Callable[..., None], *arguments: Any) -> None:
        """Call a function on the thread of the server, unless the server has ended."""
        with contextlib.suppress(RuntimeError):
            self._loop.call_soon_threadsafe(function, *arguments)

    def _broadcast(self, message: Message) -> None:
        for browser in self._browsers:
            browser.put(message)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        try:
            self._loop.run_until_complete(self._serve())
        finally:
            self._loop.close()

    async def _serve(self) -> None:
        from websockets.asyncio.server import serve

        logging.getLogger("websockets").setLevel(logging.CRITICAL)  # a browser that goes away is no news
        try:
            server = await serve(
                self._talk,
                self.host,
                self._port,
                process_request=self._respond,
                max_size=MAX_REQUEST,
                compression=None,
                ping_timeout=SILENCE,
            )
        except OSError as error:
            self._ready.set_exception(error)
            return
        self._ready.set_result(server.sockets[0].getsockname()[1])
        await self._end.wait()
        server.close()
        await server.wait_closed()

    def _respond(self, connection: Any, request: Any) -> Any:
        """The answer to a GET request; None lets a WebSocket begin."""
        from websockets.datastructures import Headers
        from websockets.http11 import Response

        def answer(status: http.HTTPStatus, body: bytes, kind: str = "text/plain") -> Response:
            headers = {
                "Content-Type": f"{kind}; charset=utf-8",
                "Content-Length": str(len(body)),
                "Content-Security-Policy": POLICY,
                "X-Content-Type-Options": "nosniff",
                "Referrer-Policy": "no-referrer",
                "Cache-Control": "no-store",
                "Connection": "close",
            }
            return Response(status.value, status.phrase, Headers(headers), body)

        parts = urlsplit(request.path)
        host = request.headers.get("Host", "")
        if self.token is None and not is_loopback(urlsplit(f"//{host}").hostname or ""):
            return answer(http.HTTPStatus.FORBIDDEN, b"This address serves its own machine alone.\n")
        if parts.path == "/socket":
            origin = request.headers.get("Origin")
            if origin is not None and urlsplit(origin).netloc != host:
                return answer(http.HTTPStatus.FORBIDDEN, b"A page of another site may not connect.\n")
            if not self._has_token(parts.query):
                return answer(http.HTTPStatus.FORBIDDEN, b"The address lacks its token.\n")
            if len(self._browsers) >= MAX_BROWSERS:
                return answer(http.HTTPStatus.SERVICE_UNAVAILABLE, b"Too many browsers are connected.\n")
            return None
        if parts.path == "/" and not self._has_token(parts.query):
            return answer(http.HTTPStatus.FORBIDDEN, b"The address lacks its token; copy it from the terminal.\n")
        name = "index.html" if parts.path == "/" else parts.path[1:]
        files = {file.name: file for file in resources.files("bokehguide.view").joinpath("page").iterdir()}
        if name not in files:
            return answer(http.HTTPStatus.NOT_FOUND, b"There is no such page.\n")
        return answer(http.HTTPStatus.OK, files[name].read_bytes(), TYPES["." + name.rpartition(".")[2]])

    def _has_token(self, query: str) -> bool:
        given = parse_qs(query).get("token", [""])[0]
        return self.token is None or secrets.compare_digest(given.encode(), self.token.encode())

    async def _talk(self, connection: Any) -> None:
        """Serve one browser until it goes away."""
        from websockets.exceptions import ConnectionClosed

        browser = _Browser()
        for message in await asyncio.to_thread(self.shown.greeting):
            browser.put(message)
        self._browsers.append(browser)
        self._tell_roles()
        self.shown.watch(True)
        sender = asyncio.create_task(self._send_waiting(connection, browser))
        try:
            async for text in connection:
                await self._follow(text, browser)
        except ConnectionClosed:
            pass
        finally:
            sender.cancel()
            self._browsers.remove(browser)
            self._tell_roles()
            if not self._browsers:
                self.shown.watch(False)

    def _tell_roles(self) -> None:
        for number, browser in enumerate(self._browsers):
            browser.put(Message("role", {"steers": number == 0, "browsers": len(self._browsers)}))

    async def _send_waiting(self, connection: Any, browser: _Browser) -> None:
        from websockets.exceptions import ConnectionClosed

        try:
            while True:
                await browser.ready.wait()
                browser.ready.clear()
                waiting, browser.waiting = browser.waiting, {}
                for message in waiting.values():
                    await connection.send(encoded(message))
        except ConnectionClosed:
            return

    async def _follow(self, text: str | bytes, browser: _Browser) -> None:
        """Follow a request, and send the answer. A browser that does not steer only looks, or takes over."""
        try:
            request = parsed(text)
            if request.get("type") == "steer":
                self._browsers.remove(browser)
                self._browsers.insert(0, browser)
                self._tell_roles()
                return
            if request.get("type") not in FREE and self._browsers[0] is not browser:
                raise BokehguideError("another browser steers; take over to change something")
            answer = await asyncio.to_thread(self.shown.handle, request)
        except BokehguideError as error:
            browser.put(Message("failure", {"failure": str(error)}))
            return
        except Exception as error:  # the page goes on
            log.exception("a request of the page failed")
            browser.put(Message("failure", {"failure": f"internal error: {error!r}"}))
            return
        if isinstance(answer, Future):
            answer.add_done_callback(lambda future: self._call(_deliver, future, browser))
        elif answer is not None:
            browser.put(answer)


def _deliver(future: Future[Message], browser: _Browser) -> None:
    """Send the result of an answer that took time."""
    try:
        browser.put(future.result())
    except CancelledError:
        return
    except BokehguideError as error:
        browser.put(Message("failure", {"failure": str(error)}))
