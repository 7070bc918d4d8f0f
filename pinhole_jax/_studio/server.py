"""The page's server, on this machine alone. Each tab has a bench.

Every request must name the token drawn when the server started, and this host: other users of the
machine, and pages of other sites, get nothing.
"""

import asyncio
import json
import secrets
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from importlib import resources
from typing import Any

from aiohttp import WSMsgType, web

from .bench import Bench
from .workpiece import Workpiece, mesh_file, photo_file

HOST = "127.0.0.1"
#: The most bytes of a message: a mask's or a session's file, in base64.
MOST_BYTES = 1 << 28
#: This many tabs are remembered.
MOST_TABS = 32
FILES = {
    "/": "text/html",
    "/scene.js": "text/javascript",
    "/studio.js": "text/javascript",
    "/studio.css": "text/css",
}
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
        app.router.add_get("/photo", self._answer_with(photo_file, "image/jpeg"))
        app.router.add_get("/mesh", self._answer_with(mesh_file, "application/octet-stream"))
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
        name = request.path.strip("/") or "index.html"
        text = (
            resources.files("pinhole_jax._studio")
            .joinpath("page", name)
            .read_text(encoding="utf-8")
        )
        text = text.replace("{TOKEN}", self.token) if name == "index.html" else text
        return web.Response(text=text, content_type=FILES[request.path], charset="utf-8")

    def _answer_with(self, make: Callable[[Workpiece], bytes], kind: str) -> Any:
        """Return a handler that sends a file of the tab's workpiece."""

        async def handler(request: web.Request) -> web.Response:
            bench = self._benches.get(request.query.get("tab", ""))
            if bench is None:
                return web.Response(status=404, text="404: no such tab\n")
            data = await self._in_thread(make, bench.workpiece)
            return web.Response(body=data, content_type=kind)

        return handler

    async def _talk(self, request: web.Request) -> web.WebSocketResponse:
        """Answer a tab's messages as long as it is open."""
        socket = web.WebSocketResponse(max_msg_size=MOST_BYTES, heartbeat=30)
        await socket.prepare(request)
        tab = self._open_tab(request.query.get("tab", ""))
        outgoing: asyncio.Queue[dict[str, Any]] = asyncio.Queue()
        outgoing.put_nowait({"push": "tab", "tab": tab})
        sender = asyncio.create_task(_send_all(socket, outgoing))
        answers: set[asyncio.Task[None]] = set()
        try:
            async for message in socket:
                if message.type == WSMsgType.TEXT:
                    answer = self._answer(self._benches[tab], message.data, outgoing)
                    task = asyncio.create_task(answer)
                    answers.add(task)
                    task.add_done_callback(answers.discard)
        finally:
            sender.cancel()
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

    async def _answer(self, bench: Bench, text: str, outgoing: "asyncio.Queue[Any]") -> None:
        loop = asyncio.get_running_loop()
        push = lambda what: loop.call_soon_threadsafe(
            outgoing.put_nowait, {"push": "progress", **what}
        )
        number = None
        try:
            number, name, numbers = _question(text)
            answer = await self._in_thread(bench.act, name, numbers, push)
            outgoing.put_nowait({"id": number, "answer": answer})
        except (ValueError, OSError) as error:
            outgoing.put_nowait({"id": number, "error": str(error)})
        except Exception as error:
            outgoing.put_nowait({"id": number, "error": f"{type(error).__name__}: {error}"})
            raise

    async def _in_thread(self, function: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._pool, function, *arguments)


def _question(text: str) -> tuple[Any, str, dict[str, Any]]:
    """Return a message's number, its action and the action's numbers, or raise ValueError."""
    question = json.loads(text)
    if not (
        isinstance(question, dict) and isinstance(question.get("do"), str) and "id" in question
    ):
        raise ValueError("expected a JSON object with `id` and `do`")
    return question.pop("id"), question.pop("do"), question


async def _send_all(socket: web.WebSocketResponse, outgoing: "asyncio.Queue[Any]") -> None:
    while True:
        message = await outgoing.get()
        text = await asyncio.to_thread(json.dumps, message)
        await socket.send_str(text)


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
