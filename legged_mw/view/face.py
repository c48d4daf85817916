"""What of ours runs on the thread of MuJoCo Studio's web viewer: the panel, the camera and the extra geoms of each picture.

Imported only where a page is asked for: a mujoco without Studio cannot import it.
"""

# pyright: reportAttributeAccessIssue=false
# (mujoco ships no type stubs)
from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Callable

import mujoco
from mujoco.studio import messages, plugin
from mujoco.studio.dear_imgui import dear_imgui
from mujoco.studio.implot import implot

from legged_mw.view.camera import CameraMan
from legged_mw.view.drive import Pilot
from legged_mw.view.overlay import draw, set_options
from legged_mw.view.panel import Panel
from legged_mw.view.puppet import Cast
from legged_mw.view.stage import Moment

DECOR_MAX = 1000  # geoms beside the model's that a page draws


class Face(plugin.ViewerPlugin):
    """An exception in a handler would end the session, so it is said once, and the picture goes on."""

    def __init__(self, cast: Cast, pilot: Pilot, title: str) -> None:
        self.cast = cast
        self.panel = Panel(pilot, title, dear_imgui, implot)
        self.begun = threading.Event()
        self._said: set[str] = set()
        self._scene: mujoco.MjvScene | None = None
        self._camera: CameraMan | None = None

    def show(self, moment: Moment) -> None:
        """What to show from now on. Called by the session's thread."""
        self.panel.show(moment)

    @messages.handler
    def on_init(self, _: plugin.ViewerInitEvent) -> None:
        self.begun.set()

    @messages.handler
    def on_model(self, event: messages.PostModelEvent) -> None:
        if event.model.nbody < 2:  # an empty one comes first
            return
        set_options(self.viewer.vis_options)
        self._scene = mujoco.MjvScene(event.model, DECOR_MAX)
        self._camera = CameraMan(self.viewer.camera, self.cast, by_hand=True)

    @messages.handler
    def on_update(self, _: messages.UpdateEvent) -> None:
        self._guard(self._update)

    @messages.handler
    def on_gui(self, _: messages.BuildGuiEvent) -> None:
        self._guard(self.panel.build)

    def _update(self) -> None:
        moment = self.panel.moment
        if moment is None or self._scene is None or self._camera is None:
            return
        self._camera.update(moment.camera, moment.world)
        self._scene.ngeom = 0
        draw(self._scene, self.cast, moment)
        self.viewer.extra_geoms[:] = self._scene.geoms[: self._scene.ngeom]

    def _guard(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:  # whatever it is, the robot walks on
            if repr(error) not in self._said:
                self._said.add(repr(error))
                traceback.print_exc(file=sys.stderr)
