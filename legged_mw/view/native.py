"""MuJoCo's own window, fed with poses, and a clock that holds a loop to real time.

Shows and listens to keys; steps no simulation. The window lives on a thread of MuJoCo's.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import os
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import mujoco
from numpy.typing import ArrayLike

from legged_mw.view.overlay import Puppet, ViewError, draw_velocities, place_camera, set_options

CLOSE_SECONDS = 5.0


def has_display() -> bool:
    """Whether a window could open here: on Linux an X or Wayland display must be named, elsewhere there always is one."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


class NativeViewer:
    """A window that shows the poses it is given. The camera follows the base; the mouse turns it.

    `on_key` is called with a GLFW key code (arrows 262 to 265, letters their ASCII capitals) on the window's thread, for
    presses only. MuJoCo's own shortcuts see the same presses: letters and digits change what is drawn, arrows do no harm.
    """

    def __init__(self, model: mujoco.MjModel, on_key: Callable[[int], None] | None = None) -> None:
        self.puppet = Puppet(model)
        self._legend = False
        before = set(threading.enumerate())
        self._handle: Any = _launch(model, self.puppet.data, on_key)
        self._threads = set(threading.enumerate()) - before
        with self._handle.lock():
            set_options(self._handle.opt)
            camera = self._handle.cam
            place_camera(camera, self.puppet)
            camera.type = mujoco.mjtCamera.mjCAMERA_TRACKING
            camera.trackbodyid = self.puppet.base

    def show(self, qpos: ArrayLike, command: ArrayLike | None = None, velocity: ArrayLike | None = None) -> None:
        """Show one pose with its arrows; (vx, vy, yaw rate) in the body frame. Does nothing once the window is closed."""
        if not self.is_running():
            return
        with self._handle.lock():  # the window's thread draws from both
            self.puppet.pose(qpos)
            self._handle.user_scn.ngeom = 0
            draw_velocities(self._handle.user_scn, self.puppet, command, velocity)
        if not self._legend and not (command is None and velocity is None):
            self._legend = True  # once: a change of text waits for the window to draw, 0.1 s with software OpenGL
            self._handle.set_texts((None, None, "orange\nblue", "command\nvelocity"))
        self._handle.sync()

    def is_running(self) -> bool:
        """False once somebody closed the window."""
        return bool(self._handle.is_running())

    def close(self) -> None:
        """Close the window and wait until it is gone; again is allowed."""
        self._handle.close()
        for thread in self._threads:  # a process that ends while the window still closes crashes in its OpenGL driver
            thread.join(timeout=CLOSE_SECONDS)

    def __enter__(self) -> NativeViewer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _launch(model: mujoco.MjModel, data: mujoco.MjData, on_key: Callable[[int], None] | None) -> Any:
    if not has_display():
        raise ViewError(
            "A window needs a display, and neither DISPLAY nor WAYLAND_DISPLAY is set. "
            "Record a video with --video FILE, or log in with `ssh -X`."
        )
    if sys.platform.startswith("linux"):
        _probe_window()
    import mujoco.viewer  # here, because it loads GLFW, which a server may lack

    try:
        return mujoco.viewer.launch_passive(model, data, key_callback=on_key, show_left_ui=False, show_right_ui=False)
    except RuntimeError as error:
        if sys.platform == "darwin":
            raise ViewError("On macOS a window needs the main thread: start with `mjpython` in place of `python`.") from error
        raise


def _probe_window() -> None:
    """Open and drop a hidden window: where that fails, `launch_passive` would wait for ever for its dead thread."""
    opened: list[bool] = []
    # on a thread of its own, for GLX may not become current where an offscreen renderer holds an EGL context
    thread = threading.Thread(target=lambda: opened.append(_can_open_window()))
    thread.start()
    thread.join()
    if opened != [True]:
        state = ", ".join(f"{name}={os.environ.get(name)!r}" for name in ("DISPLAY", "WAYLAND_DISPLAY"))
        raise ViewError(f"No OpenGL window can be opened on this display ({state}). Record a video with --video FILE.")


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


class Pace:
    """Holds a loop to one turn every `dt` seconds of real time."""

    def __init__(self, dt: float) -> None:
        self.dt = dt
        self._next = time.perf_counter() + dt

    def wait(self) -> None:
        """Sleep until this turn is over. A late loop is not hurried afterwards: lost time stays lost."""
        now = time.perf_counter()
        if self._next > now:
            time.sleep(self._next - now)
            self._next += self.dt
        else:
            self._next = now + self.dt
