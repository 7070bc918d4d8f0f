"""The page's server, on this machine alone. Each tab has a bench.

Every request must name the token drawn when the server started, and this host: other users of the
machine, and pages of other sites, get nothing.
"""

import asyncio
import json
import secrets
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from .bench import Bench, as_json
from .workpiece import mesh_file, photo_file

try:
    from aiohttp import WSMsgType, web
except ModuleNotFoundError:
    words = "expected aiohttp, which serves the page; pip install 'pinhole-jax[studio]'"
    raise ModuleNotFoundError(words, name="aiohttp") from None

HOST = "127.0.0.1"
#: The most bytes of a message: a mask's or a session's file, in base64.
MOST_BYTES = 1 << 28
#: This many tabs are remembered.
MOST_TABS = 32
#: The files of the page and, with what makes them, of a tab's workpiece; and their kinds.
FILES = {
    "/": (None, "text/html"),
    "/scene.js": (None, "text/javascript"),
    "/studio.js": (None, "text/javascript"),
    "/studio.css": (None, "text/css"),
    "/photo": (photo_file, "image/jpeg"),
    "/mesh": (mesh_file, "application/octet-stream"),
}
PAGE = Path(__file__).parent / "page"
HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'self'; img-src 'self' data: blob:;"
    " frame-ancestors 'none'; base-uri 'none'; form-action 'none'",
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}


class Studio:
    """The token, and the tabs' benches by names that only the tabs know."""

    def __init__(self, new_bench: Callable[[], Bench]) -> None:
        self.token = secrets.token_urlsafe(24)
        self._new_bench = new_bench
        self._benches: dict[str, Bench] = {}
        self._open: set[str] = set()
        self._pool = ThreadPoolExecutor(MOST_TABS, thread_name_prefix="bench")
        self.hosts: set[str] = set()

    def application(self) -> web.Application:
        """Return the server's routes, each behind the token."""
        app = web.Application(middlewares=[self._guard], client_max_size=MOST_BYTES)
        for path in FILES:
            app.router.add_get(path, self._file)
        app.router.add_get("/bench", self._talk)
        return app

    @web.middleware
    async def _guard(self, request: web.Request, handler: Any) -> web.StreamResponse:
        given = request.query.get("token", "").encode()
        known = secrets.compare_digest(given, self.token.encode())
        origin = request.headers.get("Origin")
        ours = origin is None or origin in {f"http://{host}" for host in self.hosts}
        if not (known and ours and request.host in self.hosts):
            return web.Response(status=403, text="403: open the address that the command printed\n")
        response = await handler(request)
        if not response.prepared:
            response.headers.update(HEADERS)
        return response

    async def _file(self, request: web.Request) -> web.Response:
        """Send a file of the page, which names the token where it asks for others, or one of the
        tab's workpiece."""
        make, kind = FILES[request.path]
        if make is None:
            text = (PAGE / (request.path[1:] or "index.html")).read_text(encoding="utf-8")
            return web.Response(text=text.replace("{TOKEN}", self.token), content_type=kind)
        bench = self._benches.get(request.query.get("tab", ""))
        if bench is None:
            return web.Response(status=404, text="404: no such tab\n")
        data = await asyncio.to_thread(make, bench.workpiece)
        return web.Response(body=data, content_type=kind)

    async def _talk(self, request: web.Request) -> web.WebSocketResponse:
        """Answer a tab's messages as long as it is open."""
        socket = web.WebSocketResponse(max_msg_size=MOST_BYTES, heartbeat=30)
        await socket.prepare(request)
        tab = self._open_tab(request.query.get("tab", ""))
        await socket.send_json({"push": "tab", "tab": tab})
        loop = asyncio.get_running_loop()
        send = lambda message: asyncio.run_coroutine_threadsafe(
            socket.send_str(as_json(message)), loop
        )
        try:
            async for message in socket:
                if message.type == WSMsgType.TEXT:
                    self._pool.submit(_answer, self._benches[tab], message.data, send)
        finally:
            self._open.discard(tab)
        return socket

    def _open_tab(self, tab: str) -> str:
        """Return a tab's name: its former one, unless an open tab has that."""
        if tab not in self._benches or tab in self._open:
            tab = secrets.token_urlsafe(12)
            self._benches[tab] = self._new_bench()
        self._open.add(tab)
        closed = [name for name in self._benches if name not in self._open]
        for name in closed[: max(len(self._benches) - MOST_TABS, 0)]:
            del self._benches[name]
        return tab


def _answer(bench: Bench, text: str, send: Callable[[dict[str, Any]], Any]) -> None:
    """Do what a tab's message asks for, and send the answer, or the reason why it is impossible."""
    number = None
    try:
        question = json.loads(text)
        number, name = question.pop("id"), question.pop("do")
        push = lambda news: send({"push": "progress", **news})
        send({"id": number, "answer": bench.act(name, question, push)})
    except Exception as error:
        kind = "" if isinstance(error, ValueError | OSError) else f"{type(error).__name__}: "
        send({"id": number, "error": f"{kind}{error}"})


async def serve(studio: Studio, port: int, ready: Callable[[str], Any]) -> None:
    """Serve until cancelled; call `ready` with the address and its token. Port 0: any free one."""
    runner = web.AppRunner(studio.application(), access_log=None)
    await runner.setup()
    try:
        site = web.TCPSite(runner, HOST, port)
        await site.start()
        number = runner.addresses[0][1]
        studio.hosts.update({f"{HOST}:{number}", f"localhost:{number}"})
        ready(f"http://{HOST}:{number}/?token={studio.token}")
        await asyncio.Event().wait()
    finally:
        await runner.cleanup()
