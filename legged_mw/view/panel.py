"""The web page's panel in Dear ImGui: numbers, sliders, buttons, keys and curves, for one pilot.

The viewer's thread builds the panel for every picture from the last moment and the pilot. ImGui ends the process if an
exception leaves a block open, so all code that can fail runs before a block is opened.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from legged_mw.utils.commands import with_units
from legged_mw.view.drive import KEY_ACTION, NO_COMMANDS, PUSH_MAX, SPEEDS, Pilot
from legged_mw.view.overlay import COMMAND_RGBA, VELOCITY_RGBA
from legged_mw.view.stage import FloatArray, Moment, velocity_columns

CURVE_SECONDS, CURVE_POINTS = 10.0, 100
WIDTH, COLUMN = 330, 90  # [px] width of the panel, start of its second column
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
    """Velocity and command of the followed robot over the last seconds.

    Any thread may read `rows`: it is replaced, never modified.
    """

    def __init__(self, commands: int) -> None:
        self.rows = np.zeros((0, 4 + commands))  # time, velocity (3,), command (C,)

    def add(self, moment: Moment) -> None:
        """Add a moment, and keep the last CURVE_POINTS."""
        row = np.concatenate([[moment.time], moment.velocity[moment.world], moment.commands[moment.world]])
        rows = self.rows
        if len(rows) and moment.time - rows[-1, 0] < 0.999 * CURVE_SECONDS / CURVE_POINTS:
            return
        self.rows = np.vstack([rows[-(CURVE_POINTS - 1) :], row])


class Panel:
    """The panel. `ui`, `plot`: the modules of ImGui and ImPlot."""

    def __init__(self, pilot: Pilot, title: str, ui: Any, plot: Any) -> None:
        self.pilot, self.title, self.ui, self.plot = pilot, title, ui, plot
        self.curves = Curves(len(pilot.table))
        self._folded = False
        self.moment: Moment | None = None  # the last one

    def show(self, moment: Moment) -> None:
        """Set the moment to show. Called by the session's thread."""
        self.curves.add(moment)
        self.moment = moment

    def build(self) -> None:
        """Handle the pressed keys and build the panel of one picture."""
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
            self._folded = not kept  # the close button folds the panel, a click on the title unfolds it
            if opened:
                self._numbers(moment)
                if "own" in self.pilot.can:
                    self._sliders(moment)
                self._buttons()
                self._curves()
                self._help()
        finally:
            ui.End()

    def _keys(self) -> None:
        ui = self.ui
        if ui.GetIO().WantCaptureKeyboard:  # the user types a number into a slider
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
                ui.Text(name)  # in the colour of the theme
            ui.SameLine(COLUMN)
            ui.TextWrapped(value)

    def _sliders(self, moment: Moment) -> None:
        """Draw a slider for each command. Dragging it drives the robot."""
        ui, pilot = self.ui, self.pilot
        command = np.array(pilot.command if pilot.driving else moment.commands[moment.world])
        ui.SeparatorText("command")
        if not pilot.table:
            ui.Text(NO_COMMANDS)
        for index, each in enumerate(pilot.table):
            ui.SetNextItemWidth(0.62 * WIDTH)
            changed, value = ui.SliderFloat(with_units([each]), float(command[index]), each.low, each.high, "%.2f")
            if changed:
                command[index] = value
                pilot.steer(command)

    def _buttons(self) -> None:
        ui, pilot = self.ui, self.pilot
        ui.SeparatorText("robot")
        for row in BUTTONS:
            several = [
                (action, label)
                for action, label in row
                if action in pilot.can and (action != "next" or pilot.num_worlds > 1)
            ]
            for place, (action, label) in enumerate(several):
                if place:
                    ui.SameLine()
                if ui.Button(
                    self._label(action, label), ui.Vec2(0.94 * WIDTH / 3 - 6 if len(row) == 3 else 0.47 * WIDTH - 6, 0)
                ):
                    self._click(action)
        ui.SetNextItemWidth(0.62 * WIDTH)
        if "push" in pilot.can:
            pilot.push_speed = ui.SliderFloat("push [m/s]", pilot.push_speed, 0.0, PUSH_MAX, "%.1f")[1]
        if pilot.num_worlds > 1 and ui.Checkbox("drive all robots", pilot.everyone)[0]:
            pilot.ask("everyone")

    def _label(self, action: str, label: str) -> str:
        """The text of a button. ImGui identifies the button by the part after ###."""
        pilot = self.pilot
        words = {
            **pilot.words,
            "pause": "Go on" if pilot.paused else "Pause",
            "slower": f"Speed x {pilot.speed:g}",
            "camera": f"View: {pilot.camera}",
        }
        return f"{words.get(action, label)}###{action}"

    def _click(self, action: str) -> None:
        """Do the action of the button's key. The speed button cycles through the speeds."""
        pilot = self.pilot
        if action == "slower" and pilot.speed == SPEEDS[-1]:
            for _ in SPEEDS[1:]:
                pilot.ask("faster")
        else:
            pilot.ask(action)

    def _curves(self) -> None:
        """Draw a plot for each command, with the measured velocity if the command is a velocity."""
        ui, plot, rows, table = self.ui, self.plot, self.curves.rows, self.pilot.table
        if not len(rows) or not table:
            return
        ui.SeparatorText("last 10 s: command orange, measured blue")
        times, measured = _floats(rows[:, 0] - rows[-1, 0]), velocity_columns(table)
        for index, each in enumerate(table):
            known = index in measured
            curves = {"measured": rows[:, 1 + measured[index]] if known else rows[:0, 0], "command": rows[:, 4 + index]}
            lines = [(label, times[: len(values)], _floats(values)) for label, values in curves.items()]
            margin = 0.125 * (each.high - each.low) or 1.0
            if plot.BeginPlot(f"##{each.name}", ui.Vec2(-1, 70), int(plot.Flags.CanvasOnly) | int(plot.Flags.NoInputs)):
                try:
                    plot.SetupAxes("", each.label, plot.AxisFlags.NoTickLabels, plot.AxisFlags.NoGridLines)
                    plot.SetupAxesLimits(-CURVE_SECONDS, 0.0, each.low - margin, each.high + margin, plot.Cond.Always)
                    for label, past, values in lines:  # ImPlot's first colours: blue, orange
                        plot.PlotLine(f"{label}##{each.name}", past, values)
                finally:
                    plot.EndPlot()

    def _help(self) -> None:
        ui = self.ui
        if ui.CollapsingHeader("keys") or self.pilot.help:
            for binding in self.pilot.bindings:
                ui.Text(" ".join(binding.keys))
                ui.SameLine(COLUMN)
                ui.Text(binding.text)


def _floats(values: FloatArray) -> list[float]:
    return [float(value) for value in values]
