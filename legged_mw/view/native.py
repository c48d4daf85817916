"""MuJoCo's window: shows moments and passes keys to the pilot. MuJoCo runs it on a separate thread."""

from __future__ import annotations

import os
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Any

import mujoco

from legged_mw.utils.machine import has_display
from legged_mw.view.camera import RobotCamera
from legged_mw.view.drive import BINDINGS, KEY_ACTION, Binding, Pilot
from legged_mw.view.overlay import draw
from legged_mw.view.posed_robot import PosedRobots, show_groups
from legged_mw.view.stage import Moment, ViewError

CLOSE_SECONDS = 5.0
TEXT_SECONDS = 0.1  # least time between two changes of text
_GLFW = {"right": 262, "left": 263, "down": 264, "up": 265, "space": 32, "backspace": 259, "enter": 257}
# GLFW's code of a letter is the ASCII code of its capital
KEY_CODES = {_GLFW.get(key, ord(key[0].upper())): key for key in KEY_ACTION}


Text = tuple[int | None, int | None, str, str]  # font, place, left column, right column


class NativeViewer:
    """A window. The camera follows the chosen robot; the mouse turns it. Keys go to the pilot.

    MuJoCo's shortcuts receive the same key presses and toggle drawing options (P: contact points, R: reflections ...).
    The options toggled by our keys are reverted before the next picture. All other keys work as in any MuJoCo window.
    """

    def __init__(self, spec: mujoco.MjSpec, pilot: Pilot | None = None, count: int = 1) -> None:
        self.robots, self._bindings = PosedRobots(spec, count), pilot.bindings if pilot else BINDINGS
        before = set(threading.enumerate())
        self._handle: Any = _launch(self.robots.model, self.robots.data, on_key(pilot) if pilot else None)
        self._threads = set(threading.enumerate()) - before
        self._texts: list[Text] = []  # replaced, never modified: another thread reads it
        self._ended = threading.Event()
        # a daemon, because a closed window may block it forever
        self._writer = threading.Thread(target=self._write, daemon=True)
        with self._handle.lock():
            show_groups(self._handle.opt)
            self._camera = RobotCamera(self._handle.cam, self.robots, by_hand=True)
            ours = {chr(code) for code in KEY_CODES if code < 128}
            self._own_flags = {
                i: bool(self._handle.opt.flags[i]) for i, row in enumerate(mujoco.mjVISSTRING) if row[2] in ours
            }
        self._writer.start()

    def show(self, moment: Moment) -> None:
        """Show one moment. Does nothing after the window is closed."""
        if not self.is_running():
            return
        handle = self._handle
        with handle.lock():  # the window's thread reads all of these to draw
            self.robots.pose(moment.qpos, moment.world)
            handle.user_scn.ngeom = 0
            draw(handle.user_scn, self.robots, moment)
            self._camera.update(moment.camera, moment.world)
            for flag, value in self._own_flags.items():
                handle.opt.flags[flag] = value
        self._texts = window_texts(moment, self._bindings)
        handle.sync()

    def is_running(self) -> bool:
        """Whether the window is open."""
        return bool(self._handle.is_running())

    def close(self) -> None:
        """Close the window and wait until it has closed. May be called twice."""
        self._ended.set()
        self._writer.join(timeout=CLOSE_SECONDS)
        self._handle.close()
        for thread in self._threads:  # the OpenGL driver crashes if the process ends before the window has closed
            thread.join(timeout=CLOSE_SECONDS)

    def _write(self) -> None:
        """Set the window's texts on a separate thread: each change waits for a redraw, 0.5 s with software OpenGL."""
        written: list[Text] = []
        while not self._ended.wait(TEXT_SECONDS) and self._handle.is_running():
            texts = self._texts
            if texts != written:
                self._handle.set_texts(texts)
                written = texts


def on_key(pilot: Pilot) -> Callable[[int], None]:
    """The callback for key presses. MuJoCo's window calls it with a GLFW key code on the window's thread."""
    return lambda code: pilot.press(KEY_CODES.get(code, ""))


def window_texts(moment: Moment, bindings: Sequence[Binding] = BINDINGS) -> list[Text]:
    """The text blocks for MuJoCo's window."""
    grid = mujoco.mjtGridPos
    blocks: list[Text] = []
    if moment.lines:
        names, values = ("\n".join(column) for column in zip(*moment.lines, strict=True))
        blocks.append((None, int(grid.mjGRID_TOPLEFT), names, values))
    if moment.help:
        keys = "\n".join(" ".join(binding.keys) for binding in bindings)
        blocks.append((None, int(grid.mjGRID_TOPRIGHT), keys, "\n".join(binding.text for binding in bindings)))
    blocks.append((None, int(grid.mjGRID_BOTTOMLEFT), "orange\nblue\nh", "command\nmeasured\nkeys"))
    return blocks


def _launch(model: mujoco.MjModel, data: mujoco.MjData, on_key: Callable[[int], None] | None) -> Any:
    if not has_display():
        raise ViewError(
            "A window needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set. "
            "Open a web page with --viewer web, record a video with --video FILE, or log in with `ssh -X`."
        )
    if sys.platform.startswith("linux"):
        _probe_window()
    import mujoco.viewer  # imported here because it loads GLFW, which a server may lack

    try:
        return mujoco.viewer.launch_passive(model, data, key_callback=on_key, show_left_ui=False, show_right_ui=False)
    except RuntimeError as error:
        if sys.platform == "darwin":
            raise ViewError(
                "On macOS a window needs the main thread: start with `mjpython` in place of `python`."
            ) from error
        raise


def _probe_window() -> None:
    """Open and close a hidden window as a test. If that fails, `launch_passive` would wait forever."""
    opened: list[bool] = []
    # on a separate thread: GLX cannot become current on a thread where an offscreen renderer holds an EGL context
    thread = threading.Thread(target=lambda: opened.append(_can_open_window()))
    thread.start()
    thread.join()
    if opened != [True]:
        state = ", ".join(f"{name}={os.environ.get(name)!r}" for name in ("DISPLAY", "WAYLAND_DISPLAY"))
        raise ViewError(
            f"No OpenGL window can be opened on this display ({state}). "
            "Open a web page with --viewer web, or record a video with --video FILE."
        )


def _can_open_window() -> bool:
    import glfw

    if not glfw.init():
        return False
    glfw.window_hint(glfw.VISIBLE, glfw.FALSE)
    window = glfw.create_window(64, 64, "", None, None)
    glfw.default_window_hints()
    if window:
        glfw.destroy_window(window)
    return bool(window)
