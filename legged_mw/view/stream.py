"""The page of pictures, for a browser that draws too slowly, on the same guarded port. It also handles all pages' keys.

`/drawn` is the page and `/stream` its WebSocket, which also gets the keys of Studio's page. A browser requests each
picture, so a slow link gets fewer. One thread draws them all, with its own camera, which the driving page turns.
"""

from __future__ import annotations

import asyncio
import copy
import io
import json
import os
import sys
import time
from collections import deque
from collections.abc import Awaitable, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial
from pathlib import Path
from typing import Any

import mujoco

from legged_mw.view.drive import ACTIONS
from legged_mw.view.panel import Panel
from legged_mw.view.posed_robot import PosedRobots
from legged_mw.view.recorder import RobotRenderer
from legged_mw.view.stage import ViewError

PAGE = Path(__file__).with_name("drawn.html").read_bytes()
ADDED = Path(__file__).with_name("studio.html").read_bytes()  # for Studio's page: it measures and sends keys
WIDTH, HEIGHT = 640, 360  # [px] size of a picture
FPS = 15.0  # ours: largest number of pictures per second; software OpenGL needs a whole core for more
QUALITY = 80  # ours: quality of the JPEGs, of 100; a picture has about 18 kB
VIDEO_FPS = 25.0  # frame rate for the camera's filters
WATCHERS = 9  # largest number of pages, as in Studio
MESSAGE, MOST = 200, 100.0  # of a page's request: largest length, largest number
SILENT = 10.0  # [s] a page without a request for this time is inactive, so that another page may drive
NEXT = "next"  # a page's request for a picture
# codes for closing: Studio's for a page that may not drive and for too many pages, WebSocket's for a bad request
TAKEN, FULL, BAD = 4001, 4002, 1008

Handler = Callable[[Any], Awaitable[None]]


class Stream:
    """Pictures, numbers and requests of the pages at `/stream`. The first page of either kind drives."""

    def __init__(self, robots: PosedRobots, panel: Panel) -> None:
        self._robots, self._panel = copy.deepcopy(robots), panel  # to compile them would stop the session
        self._artist = ThreadPoolExecutor(1, "artist", _step_back)  # only one thread may use an OpenGL context
        self._renderer: RobotRenderer | None = None  # made at the first request
        self._picture, self._drawn = b"", 0.0  # the last JPEG, its time [s]
        self._moves: deque[tuple[int, float, float]] = deque(maxlen=100)  # camera motion for the next picture
        self._studio: list[tuple[Any, str]] = []  # Studio's sockets at /ui, and their sessions
        self._watching: dict[Any, float] = {}  # sockets with a request -> time of the last request [s]

    def around(self, studio: Handler) -> Handler:
        """Studio's WebSocket handler with `/stream` added. While our page drives, no page of Studio's does."""
        from websockets.exceptions import ConnectionClosed

        async def handle(socket: Any) -> None:
            path, _, query = socket.request.path.partition("?")
            if path == "/stream":
                with suppress(ConnectionClosed):
                    await self._serve(socket, query)
            elif path != "/ui":
                await studio(socket)
            elif self._first() is not None and self._controller() is None:
                await socket.close(TAKEN, "another browser drives")
            else:
                self._studio.append((socket, query))
                try:
                    await studio(socket)
                finally:
                    self._studio.remove((socket, query))

        return handle

    def close(self) -> None:
        """Free the OpenGL context. May be called twice."""
        with suppress(RuntimeError):  # the interpreter ends, or the thread pool is already closed
            self._artist.submit(self._free)
        self._artist.shutdown()

    def _free(self) -> None:
        """Free the OpenGL context. It runs on the drawing thread, which may just have made it."""
        renderer, self._renderer = self._renderer, None
        if renderer is not None:
            renderer.close()

    async def _serve(self, socket: Any, session: str) -> None:
        """Answer one page until it leaves or asks for what there is not."""
        asked, sender = asyncio.Semaphore(0), None
        try:
            async for message in socket:
                if message != NEXT:
                    if not self._obey(message, self._drives(socket, session)):
                        await socket.close(BAD, "no such request")
                    continue
                if sender is None and len(self._watching) >= WATCHERS:
                    await socket.close(FULL, f"{WATCHERS} browsers watch already")
                    continue
                sender = sender or asyncio.create_task(self._send(socket, asked))
                self._watching[socket] = time.monotonic()
                asked.release()
        finally:
            if sender is not None:
                del self._watching[socket]
                sender.cancel()

    def _drives(self, socket: Any, session: str) -> bool:
        """Whether this page drives. Of Studio's pages, the accepted one drives. Where none can drive, each may ask."""
        if "own" not in self._panel.pilot.can:  # a real robot's pages: any of them may damp it
            return True
        controller = self._controller()
        return socket is self._first() if controller is None else session == controller

    def _controller(self) -> str | None:
        """The session of the first page of Studio's that is not refused."""
        from websockets.protocol import State

        return next((session for each, session in self._studio if each.state is State.OPEN), None)

    def _first(self) -> Any:
        """The first of our pages that still sends requests."""
        now = time.monotonic()
        return next((each for each, last in self._watching.items() if now - last < SILENT), None)

    async def _send(self, socket: Any, asked: asyncio.Semaphore) -> None:
        """Send the panel's numbers and a picture for each request that `asked` counts."""
        from websockets.exceptions import ConnectionClosed

        loop, due = asyncio.get_running_loop(), 0.0
        with suppress(ConnectionClosed):
            while True:
                await asked.acquire()
                await asyncio.sleep(max(0.0, due - loop.time()))
                while self._panel.moment is None:  # the session has not begun
                    await asyncio.sleep(1.0 / FPS)
                due = max(due + 1.0 / FPS, loop.time())
                try:
                    picture = await loop.run_in_executor(self._artist, self._draw)
                except Exception as error:  # the robot's state is not finite, or this machine cannot draw
                    await socket.send(json.dumps({"error": f"the server cannot draw: {error}"}))
                    await socket.close()
                    return
                await socket.send(json.dumps({**self._panel.facts(), "drives": self._drives(socket, "")}))
                await socket.send(picture)

    def _draw(self) -> bytes:
        """The current picture as a JPEG, or the last one if it is recent. It runs on the drawing thread."""
        now, moment = time.monotonic(), self._panel.moment
        if moment is not None and now - self._drawn > 0.5 / FPS:
            try:
                from PIL import Image
            except ImportError as error:  # a robot's computer may lack it
                raise ViewError(f"its JPEGs are written by Pillow ({error}): pip install pillow") from None
            if self._renderer is None:
                self._renderer = RobotRenderer(self._robots, WIDTH, HEIGHT, live=True)
            while self._moves:
                self._renderer.move_camera(*self._moves.popleft())
            frame = self._renderer.frame(moment._replace(lines=()), (now - self._drawn) * VIDEO_FPS)
            file = io.BytesIO()
            Image.fromarray(frame).save(file, "JPEG", quality=QUALITY)
            self._picture, self._drawn = file.getvalue(), now
        return self._picture

    def _obey(self, message: str | bytes, drives: bool) -> bool:
        """Do a request of the driving page: a JSON list with a verb and its values. False: an unknown request.

        Requests of other pages have no effect. The allowed requests are those of the panel.
        """
        panel, request = self._panel, _request(message)
        match request:
            case ["press", str(key)]:
                act = partial(panel.press, key, studio=self._controller() is not None)
            case ["click", str(action)] if action in ACTIONS:
                act = partial(panel.click, action)
            case ["steer", int(column), float(value) | int(value)] if 0 <= column < len(panel.pilot.table):
                act = partial(panel.steer, column, value)
            case ["push", float(speed) | int(speed)]:
                act = partial(panel.set_push, speed)
            case ["turn", float(x) | int(x), float(y) | int(y)]:  # fraction of the picture's height
                act = partial(self._moves.append, (mujoco.mjtMouse.mjMOUSE_ROTATE_V, x, y))
            case ["zoom", float(y) | int(y)]:
                act = partial(self._moves.append, (mujoco.mjtMouse.mjMOUSE_ZOOM, 0.0, y))
            case _:
                return False
        if drives:
            act()
        return True


def _step_back() -> None:
    """Lower the priority of this thread and of OpenGL's threads that it starts: the control loop has priority."""
    if sys.platform == "linux":  # on other systems this changes the whole process
        os.nice(5)


def _request(message: str | bytes) -> list[str | float] | None:
    """The texts and numbers of a page's message; numbers within +-MOST. None for any other message."""
    try:
        request = json.loads(message) if len(message) <= MESSAGE else None
    except ValueError:
        return None
    sound = isinstance(request, list) and all(
        isinstance(each, str) or (isinstance(each, int | float) and abs(each) <= MOST) for each in request
    )
    return request if sound else None
