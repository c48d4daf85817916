"""The web page's panel, built from Dear ImGui: sliders, buttons, keys and curves that speak to a pilot.

Built anew for every picture, on the viewer's thread, out of the last moment and the pilot; draws no robot. All that may
fail is computed before a block is opened: ImGui ends the process where a block is left open.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from legged_mw.view.drive import BINDINGS, COMPONENTS, KEY_ACTION, PUSH_MAX, SPEEDS, UNITS, Pilot
from legged_mw.view.overlay import COMMAND_RGBA, VELOCITY_RGBA
from legged_mw.view.stage import Moment

CURVE_SECONDS, CURVE_POINTS = 10.0, 100
WIDTH, COLUMN = 330, 90  # [px] of the panel, where its second column begins
_KEYS = {  # ours -> ImGui's
    **{"up": "UpArrow", "down": "DownArrow", "left": "LeftArrow", "right": "RightArrow"},
    **{"space": "Space", "backspace": "Backspace", "enter": "Enter", "-": "Minus", "=": "Equal"},
}
KEY_NAMES = {key: _KEYS.get(key, key.upper()) for key in KEY_ACTION}
BUTTONS = (  # rows of (action, label)
    (("stop", "Stop"), ("push", "Push"), ("reset", "Reset")),
    (("pause", "Pause"), ("slower", "Slow"), ("camera", "Camera")),
    (("next", "Next robot"), ("own", "Task's commands")),
)


class Curves:
    """Command and velocity of the followed robot over the last seconds. `rows` is replaced, never changed: any thread may read it."""

    def __init__(self) -> None:
        self.rows = np.zeros((0, 7))  # time, command (3,), velocity (3,)

    def add(self, moment: Moment) -> None:
        """Note a moment; at most CURVE_POINTS are kept, and a reset of time begins anew."""
        row = np.concatenate([[moment.time], moment.commands[moment.world], moment.velocity[moment.world]])
        rows = self.rows
        if len(rows) and moment.time - rows[-1, 0] < 0.999 * CURVE_SECONDS / CURVE_POINTS:
            return
        self.rows = np.vstack([rows[-(CURVE_POINTS - 1) :], row])


class Panel:
    """What the page shows and what it does with the mouse and the keys. `ui` and `plot` are ImGui's and ImPlot's modules."""

    def __init__(self, pilot: Pilot, title: str, ui: Any, plot: Any) -> None:
        self.pilot, self.title, self.ui, self.plot = pilot, title, ui, plot
        self.curves = Curves()
        self._folded = False
        self.moment: Moment | None = None  # the last one; replaced by the session's thread

    def show(self, moment: Moment) -> None:
        """What to speak of from now on. Called by the session's thread."""
        self.curves.add(moment)
        self.moment = moment

    def build(self) -> None:
        """One picture's panel, and the keys pressed since the last."""
        moment = self.moment
        if moment is None:
            return
        ui = self.ui
        self._keys()
        ui.SetNextWindowPos(ui.Vec2(12, 12), ui.Cond.FirstUseEver)
        ui.SetNextWindowSize(ui.Vec2(WIDTH, 0), ui.Cond.FirstUseEver)
        if self._folded:
            ui.SetNextWindowCollapsed(True)
        try:
            opened, kept = ui.Begin(self.title, True, ui.WindowFlags.NoFocusOnAppearing)
            self._folded = not kept  # the cross folds the panel: the session goes on, and a click on the title unfolds it
            if opened:
                self._numbers(moment)
                self._sliders(moment)
                self._buttons()
                self._curves()
                self._help()
        finally:
            ui.End()

    def _keys(self) -> None:
        ui = self.ui
        if ui.GetIO().WantCaptureKeyboard:  # somebody types a number into a slider
            return
        for key, name in KEY_NAMES.items():
            if ui.IsKeyPressed(getattr(ui.Key, name), False):
                self.pilot.press(key)

    def _numbers(self, moment: Moment) -> None:
        ui = self.ui
        colours = {"command": COMMAND_RGBA, "measured": VELOCITY_RGBA}
        for name, value in moment.lines:
            if name in colours:
                ui.TextColored(ui.Vec4(*colours[name]), name)
            else:
                ui.Text(name)  # in the theme's colour, which may be light or dark
            ui.SameLine(COLUMN)
            ui.Text(value)

    def _sliders(self, moment: Moment) -> None:
        """The command; what is dragged is driven."""
        ui, pilot = self.ui, self.pilot
        command = np.array(pilot.command if pilot.driving else moment.commands[moment.world])
        ui.SeparatorText("command")
        for index, (name, unit) in enumerate(zip(COMPONENTS, UNITS, strict=True)):
            low, high = (float(limit) for limit in pilot.limits[:, index])
            ui.SetNextItemWidth(0.62 * WIDTH)
            changed, value = ui.SliderFloat(f"{name} [{unit}]", float(command[index]), low, high, "%.2f")
            if changed:
                command[index] = value
                pilot.steer(command)

    def _buttons(self) -> None:
        ui, pilot = self.ui, self.pilot
        ui.SeparatorText("robot")
        for row in BUTTONS:
            several = [(action, label) for action, label in row if action != "next" or pilot.num_worlds > 1]
            for place, (action, label) in enumerate(several):
                if place:
                    ui.SameLine()
                if ui.Button(self._label(action, label), ui.Vec2(0.94 * WIDTH / 3 - 6 if len(row) == 3 else 0.47 * WIDTH - 6, 0)):
                    self._click(action)
        ui.SetNextItemWidth(0.62 * WIDTH)
        changed, value = ui.SliderFloat("push [m/s]", pilot.push_speed, 0.0, PUSH_MAX, "%.1f")
        if changed:
            pilot.push_speed = value
        if pilot.num_worlds > 1 and ui.Checkbox("drive all robots", pilot.everyone)[0]:
            pilot.ask("everyone")

    def _label(self, action: str, label: str) -> str:
        """What the button will do; the part after ### keeps it the same button."""
        pilot = self.pilot
        words = {"pause": "Go on" if pilot.paused else "Pause", "slower": f"Speed x {pilot.speed:g}", "camera": f"View: {pilot.camera}"}
        return f"{words.get(action, label)}###{action}"

    def _click(self, action: str) -> None:
        """A button does what its key does; the one for speed goes round."""
        pilot = self.pilot
        if action == "slower" and pilot.speed == SPEEDS[-1]:
            for _ in SPEEDS[1:]:
                pilot.ask("faster")
        else:
            pilot.ask(action)

    def _curves(self) -> None:
        """Measured and commanded, in the colours of the arrows."""
        ui, plot, rows, limits = self.ui, self.plot, self.curves.rows, self.pilot.limits
        if not len(rows):
            return
        ui.SeparatorText("last 10 s: command orange, measured blue")
        times = [float(t) for t in rows[:, 0] - rows[-1, 0]]
        curves = [[[float(v) for v in rows[:, 1 + part + index]] for part in (3, 0)] for index in range(3)]
        for index, name in enumerate(COMPONENTS):
            low, high = (1.25 * float(limit) for limit in limits[:, index])
            if plot.BeginPlot(f"##{name}", ui.Vec2(-1, 70), int(plot.Flags.CanvasOnly) | int(plot.Flags.NoInputs)):
                try:
                    plot.SetupAxes("", name, plot.AxisFlags.NoTickLabels, plot.AxisFlags.NoGridLines)
                    plot.SetupAxesLimits(-CURVE_SECONDS, 0.0, low, high, plot.Cond.Always)
                    for label, values in zip(("measured", "command"), curves[index], strict=True):  # ImPlot's first colours: blue, orange
                        plot.PlotLine(f"{label}##{name}", times, values)
                finally:
                    plot.EndPlot()

    def _help(self) -> None:
        ui = self.ui
        if ui.CollapsingHeader("keys") or self.pilot.help:
            for binding in BINDINGS:
                ui.Text(" ".join(binding.keys))
                ui.SameLine(COLUMN)
                ui.Text(binding.text)
