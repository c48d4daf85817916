"""Our plugin for MuJoCo Studio's web viewer: the panel, the camera and the extra geoms of each picture.

It runs on the viewer's thread. Import it only to open a page: the import fails if mujoco lacks Studio.
"""

# pyright: reportAttributeAccessIssue=false
# (parts of mujoco.studio that its own types do not name)
from __future__ import annotations

import sys
import threading
import traceback
from collections.abc import Callable

import mujoco
from mujoco.studio import messages, plugin
from mujoco.studio.dear_imgui import dear_imgui
from mujoco.studio.implot import implot
from mujoco.studio.web import state_payload

from legged_mw.view.camera import RobotCamera
from legged_mw.view.drive import Pilot
from legged_mw.view.overlay import draw
from legged_mw.view.panel import Panel
from legged_mw.view.posed_robot import PosedRobots, show_groups
from legged_mw.view.stage import Moment


class StudioPlugin(plugin.ViewerPlugin):
    """The plugin. An exception in a handler would end the session, so it is printed once and the session continues."""

    def __init__(self, robots: PosedRobots, pilot: Pilot, title: str) -> None:
        self.robots = robots
        self.lock = threading.Lock()  # guards the robots' poses
        self.panel = Panel(pilot, title, dear_imgui, implot)
        self.begun = threading.Event()
        self._printed: set[str] = set()
        self._scene: mujoco.MjvScene | None = None
        self._camera: RobotCamera | None = None

    def show(self, moment: Moment) -> None:
        """Set the moment to show. Called by the session's thread."""
        self.panel.show(moment)

    @messages.handler
    def on_init(self, _: plugin.ViewerInitEvent) -> None:
        self.begun.set()

    @messages.handler
    def on_model(self, event: messages.PostModelEvent) -> None:
        if event.model.nbody < 2:  # the first model is empty
            return
        show_groups(self.viewer.vis_options)
        self._scene = mujoco.MjvScene(event.model, state_payload.MAX_EXTRA_GEOMS)
        with self.lock:
            self._camera = RobotCamera(self.viewer.camera, self.robots, by_hand=True)

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
        self._scene.ngeom = 0
        with self.lock:
            self._camera.update(moment.camera, moment.world)
            draw(self._scene, self.robots, moment)
        self.viewer.extra_geoms[:] = self._scene.geoms[: self._scene.ngeom]

    def _guard(self, work: Callable[[], None]) -> None:
        try:
            work()
        except Exception as error:
            if repr(error) not in self._printed:
                self._printed.add(repr(error))
                traceback.print_exc(file=sys.stderr)
