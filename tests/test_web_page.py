"""The web page, MuJoCo Studio's: a process opens one once, so the tests share it."""

from __future__ import annotations

import asyncio
import io
import json
import shutil
import socket
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import closing, suppress
from typing import Any

import mujoco
import numpy as np
import pytest

from legged_mw.utils.commands import Command
from legged_mw.view.drive import PUSH_MAX, Pilot
from legged_mw.view.stage import Moment, ViewError
from legged_mw.view.web import LOCAL, MOST, WebViewer, listen

SPEC = mujoco.MjSpec.from_string(  # pyright: ignore[reportAttributeAccessIssue]
    "<mujoco><worldbody><geom type='plane' size='1 1 .1'/><body><freejoint/><geom size='.1'/></body></worldbody></mujoco>"
)
THREE = tuple(
    Command(name, -1.0, 1.0, unit)
    for name, unit in (("lin_vel_x", "m/s"), ("lin_vel_y", "m/s"), ("ang_vel_yaw", "rad/s"))
)


@pytest.fixture(scope="module")
def pilot() -> Pilot:
    return Pilot(THREE, 2)


@pytest.fixture(scope="module")
def page(pilot: Pilot) -> Iterator[WebViewer]:
    """A page of two robots. Its server's thread starts late, as it can on a busy machine."""
    from mujoco.studio.web import web_server

    serve = web_server.serve

    async def late(*args: Any, **settings: Any) -> Any:
        await asyncio.sleep(0.3)
        return await serve(*args, **settings)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(web_server, "serve", late)
        with closing(WebViewer(SPEC, pilot, 2)) as page:
            now = np.zeros((2, 3))
            pose = np.tile([0, 0, 1, 1, 0, 0, 0.0], (2, 1))
            for _ in range(3):
                page.show(Moment(0.0, pose, now, now, now, np.ones((2, 0), dtype=bool)))
            yield page
    assert not page.is_running()


def answer(port: int, path: str = "/", **headers: str) -> tuple[int, str, Any]:
    request = urllib.request.Request(
        f"http://127.0.0.1:{port}{path}", headers={k.replace("_", "-"): v for k, v in headers.items()}
    )
    try:
        with urllib.request.urlopen(request, timeout=10) as got:
            return got.status, got.read().decode(), got.headers
    except urllib.error.HTTPError as error:
        return error.code, error.read().decode(), error.headers


BAD_REQUESTS: list[str | bytes] = [
    *("", "x", "[]", "null", "{}", '["press"]', '["press", 1]', '["click", "jump"]', '["steer", 3, 1]', '["steer", -1, 1]'),
    *('["turn", NaN, 0]', '["zoom", 1e999]', '["push", -1e30]', '["push", "fast"]', f'["press", "{"x" * 300}"]', "[" * 150),
    *(b"\xff", b"\x00" * 3000),
]  # fmt: skip


def watch(url: str, own: Any, pilot: Pilot) -> None:
    """Pictures drawn by the server: of the right size, not black; the first page drives, and a bad request ends a page."""
    from PIL import Image
    from websockets.exceptions import ConnectionClosed
    from websockets.sync.client import connect

    def look(page: Any) -> tuple[dict[str, Any], bytes]:
        page.send("next")
        facts = json.loads(page.recv(timeout=60))
        assert "error" not in facts
        return facts, page.recv(timeout=60)

    with connect(url + "/stream", origin=own) as late:
        with connect(url + "/stream", origin=own) as driver:
            (facts, picture), (watched, _) = look(driver), look(late)
            assert facts["drives"] and not watched["drives"] and facts["buttons"] and facts["push"]
            image = Image.open(io.BytesIO(picture))
            assert (image.format, image.size) == ("JPEG", (640, 360)) and np.asarray(image).max() > 100
            for page in (late, driver):
                for request in ('["press", "p"]', '["turn", 0.4, 0.1]', '["zoom", -0.1]', '["push", 99]'):
                    page.send(request)
                turned = look(page)
            pilot.listen()
            assert len(pilot.take_pushes()) == 1 and pilot.push_speed == PUSH_MAX and turned[1] != picture
            with connect(url + "/ui?sid=1", origin=own) as studio, pytest.raises(ConnectionClosed, match="4001"):
                studio.recv(timeout=10)
            for request in BAD_REQUESTS:
                with connect(url + "/stream", origin=own) as page, pytest.raises(ConnectionClosed, match="1008"):
                    page.send(request)
                    page.recv(timeout=10)
        until = time.monotonic() + 10
        while not look(late)[0]["drives"]:
            assert time.monotonic() < until


def test_the_page_is_served_on_this_machine_alone_and_once_in_a_process(page: WebViewer, pilot: Pilot) -> None:
    from mujoco.studio import web_viewer

    assert page._plugin.viewer._http_sock.getsockname()[0] == "127.0.0.1"  # pyright: ignore[reportAttributeAccessIssue]
    status, text, headers = answer(page.port)
    assert status == 200 and "canvas" in text and 'href="/drawn"' in text
    assert "let currentModelCrc = 0;" in text  # of Studio's own: our script waits for it
    assert (headers["X-Frame-Options"], headers["Access-Control-Allow-Origin"]) == ("DENY", None)
    with pytest.raises(OSError):  # any other address of this machine
        urllib.request.urlopen(f"http://[::1]:{page.port}/", timeout=2)
    with pytest.raises(ViewError, match="this process has opened a page, .* opens one in a process"):
        WebViewer(SPEC, pilot)
    with pytest.raises(ViewError, match=rf"--port {page.port} is in use on 127.0.0.1; leave it out"):
        WebViewer(SPEC, pilot, port=page.port)
    with pytest.raises(ViewError, match=r"--host 203.0.113.7: this machine has no such address"):
        WebViewer(SPEC, pilot, host="203.0.113.7")
    with pytest.raises(ViewError, match="--host"):  # which a socket takes for every interface
        WebViewer(SPEC, pilot, host="")
    assert not hasattr(web_viewer, "print"), "Studio's own words are its own again"


def test_pages_that_start_at_once_have_ports_of_their_own() -> None:
    with listen(LOCAL) as first, listen(LOCAL) as second:
        assert first.getsockname()[1] != second.getsockname()[1]


def test_the_page_is_guarded(page: WebViewer, pilot: Pilot) -> None:
    from websockets.exceptions import ConnectionClosed, InvalidStatus
    from websockets.sync.client import connect

    for refused in ({"Host": "evil.test"}, {"Origin": "http://evil.test"}, {"Sec_Fetch_Site": "cross-site"}):
        status, text, headers = answer(page.port, "/model", **refused)
        assert status == 403 and text.count("\n") == 1 and headers["Cache-Control"] == "no-store"
    url, own = f"ws://127.0.0.1:{page.port}", f"http://127.0.0.1:{page.port}"
    for path, origin in (
        ("/ui", "http://evil.test"),
        ("/stream", "http://evil.test"),
        ("/stream", None),
        ("/drop", own),
    ):
        with pytest.raises(InvalidStatus, match="403"):
            connect(url + path, origin=origin)  # pyright: ignore[reportArgumentType]
    with connect(f"{url}/state?sid=1", origin=own) as state:  # pyright: ignore[reportArgumentType]
        for message in (
            "max_spectators=99999999999999999999",
            "theme=\x1b[31m",
            b"",
            bytes(63),
            b"\xff" * 64,
            "x" * 1000,
        ):
            state.send(message)
        with suppress(ConnectionClosed):
            state.send(bytes(MOST + 1))
        with pytest.raises(ConnectionClosed, match="1009"):
            while True:
                state.recv(timeout=10)
    watch(url, own, pilot)
    with socket.create_connection(("127.0.0.1", page.port)) as raw:
        raw.sendall(b"\x00\xff" * 500 + b"\r\n\r\n")
    assert answer(page.port)[0] == 200 and page.is_running()


# Studio's program as far as our script sees it, 3 frames a second: it has its model and drives
SLOW = """currentModelCrc = 1; Module.session_id = "7"; new WebSocket(origin.replace("http", "ws") + "/ui?sid=7");
(function frame() { const end = performance.now() + 300; while (performance.now() < end); requestAnimationFrame(frame); })()"""


# the tab is hidden or shown; a stand-in for Studio's link shows what is asked there
SEEN = """(hidden) => { Object.defineProperty(document, "hidden", { value: hidden, configurable: true });
session = { send: (word) => { document.title = word; } }; document.dispatchEvent(new Event("visibilitychange")); }"""
ASK = """new WebSocket(origin.replace("http", "ws") + "/ui?sid=7")"""


@pytest.mark.browser
def test_a_slow_browser_gets_pictures_and_no_short_key_is_lost(page: WebViewer, pilot: Pilot) -> None:
    from playwright.sync_api import sync_playwright  # pyright: ignore[reportMissingImports]

    def pressed(tab: Any) -> int:
        for _ in range(3):
            tab.keyboard.press("p")
        pushes, until = 0, time.monotonic() + 20
        while pushes < 3 and time.monotonic() < until:
            tab.wait_for_timeout(100)
            pilot.listen()
            pushes += len(pilot.take_pushes())
        return pushes

    wrong = list[str]()
    with sync_playwright() as play:
        browser = play.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        tab = browser.new_page(viewport={"width": 390, "height": 800})
        tab.on("pageerror", lambda error: wrong.append(str(error)))
        tab.route("**/web_client.js", lambda route: route.fulfill(body=SLOW, content_type="text/javascript"))
        tab.goto(f"{page.url}#browser")
        tab.wait_for_function("shown.length > 3")
        assert pressed(tab) == 3 and tab.url.endswith("#browser")  # as asked, however slow
        tab.evaluate(SEEN, True)  # a hidden tab leaves, so that another page drives
        other = browser.new_page()
        other.goto(f"{page.url}drawn")
        other.wait_for_function("facts?.drives")
        tab.evaluate(SEEN, False)
        tab.evaluate(ASK)
        tab.wait_for_function("document.title === 'request_control'")  # refused, it joins the queue
        other.close()
        tab.goto(f"{page.url}?")
        tab.wait_for_url("**/drawn#*")
        tab.wait_for_function("facts?.drives && times.length > 1")
        assert pressed(tab) == 3 and "drawn by the server" in tab.inner_text("#how")
        assert tab.evaluate("document.documentElement.scrollWidth") == 390 and not tab.is_visible("#buttons")
        tab.click("#title")
        assert tab.is_visible("#buttons") and pilot.command[0] == 0.0
        tab.locator("#sliders input").first.fill("0.5")
        tab.get_by_text("Stop", exact=True).wait_for()
        tab.wait_for_timeout(200)
        pilot.listen()
        assert pilot.driving and pilot.command.tolist() == [0.5, 0, 0]
        browser.close()
    assert wrong == []
