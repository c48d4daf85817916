"""The web page's panel for one pilot: numbers, sliders, buttons, keys and curves in Dear ImGui; all but curves as data.

The viewer's thread builds the panel for every picture from the last moment and the pilot. ImGui ends the process if an
exception leaves a block open, so all code that can raise runs before a block is opened. Keys do not go through ImGui,
which reads them once per picture: the page sends each key at once.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from legged_mw.utils.commands import with_units
from legged_mw.view.drive import NO_COMMANDS, PUSH_MAX, SPEEDS, Pilot
from legged_mw.view.overlay import COMMAND_RGBA, VELOCITY_RGBA
from legged_mw.view.stage import FloatArray, Moment, velocity_columns

CURVE_SECONDS, CURVE_POINTS = 10.0, 100
WIDTH, COLUMN = 330, 90  # [px] width of the panel, start of its second column
NARROW = 600  # [px] on a narrower screen, such as a phone's, the panel is folded at first
KEY_NAMES = {  # KeyboardEvent.key of a browser -> our name, if it is not the same letter
    **{"ArrowUp": "up", "ArrowDown": "down", "ArrowLeft": "left", "ArrowRight": "right"},
    **{" ": "space", "Backspace": "backspace", "Enter": "enter"},
}
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
        self._folded = self._narrow = False
        self._typing = False  # the user types a number into a slider of ImGui
        self.moment: Moment | None = None  # the last one

    def show(self, moment: Moment) -> None:
        """Set the moment to show. Called by the session's thread."""
        self.curves.add(moment)
        self.moment = moment

    def build(self) -> None:
        """Build the panel of one picture."""
        moment = self.moment
        if moment is None:
            return
        ui = self.ui
        self._typing = bool(ui.GetIO().WantCaptureKeyboard)
        before, self._narrow = self._narrow, 0 < ui.GetIO().DisplaySize.x < NARROW
        self._folded |= self._narrow and not before
        ui.SetNextWindowPos(ui.Vec2(12, 12), ui.Cond.FirstUseEver)
        ui.SetNextWindowSize(ui.Vec2(WIDTH, 0), ui.Cond.FirstUseEver)
        if self._folded:
            ui.SetNextWindowCollapsed(True)
        try:
            opened, is_open = ui.Begin(self.title, True, ui.WindowFlags.NoFocusOnAppearing)
            self._folded = not is_open  # the close button folds the panel, a click on the title unfolds it
            if opened:
                self._numbers(moment)
                if "own" in self.pilot.can:
                    self._sliders(moment)
                self._buttons()
                self._curves()
                self._help()
        finally:
            ui.End()

    # ---- requests of a page, from any thread

    def press(self, key: str, studio: bool) -> None:
        """Do the action of a browser's key. `studio`: pressed on Studio's page, where the user may type a number."""
        if not (studio and self._typing):
            self.pilot.press(KEY_NAMES.get(key, key.lower()))

    def click(self, action: str) -> None:
        """Do the action of a button. The speed button cycles through the speeds."""
        pilot = self.pilot
        if action == "slower" and pilot.speed == SPEEDS[-1]:
            for _ in SPEEDS[1:]:
                pilot.ask("faster")
        else:
            pilot.ask(action)

    def steer(self, column: int, value: float) -> None:
        """Drive by the shown commands with `value` in this column."""
        if "own" in self.pilot.can and self.moment is not None:
            self.pilot.steer_one(column, value, self._command(self.moment))

    def set_push(self, speed: float) -> None:
        """Set the speed [m/s] of a push."""
        self.pilot.push_speed = min(max(speed, 0.0), PUSH_MAX)

    def facts(self) -> dict[str, Any]:
        """The panel as JSON data, for a page without ImGui."""
        pilot, moment, sliders = self.pilot, self.moment, []
        if moment is not None and "own" in pilot.can:
            values = self._command(moment)
            sliders = [
                [with_units([each]), each.low, each.high, float(value)]
                for each, value in zip(pilot.table, values, strict=True)
            ]
        rows = [[[action, self._words(action, label)] for action, label in row] for row in self._rows()]
        if pilot.num_worlds > 1:
            rows.append([["everyone", "Drive one robot" if pilot.everyone else "Drive all robots"]])
        return {
            "title": self.title,
            "lines": moment.lines if moment else (),
            "sliders": sliders,
            "buttons": rows,
            "push": [pilot.push_speed, PUSH_MAX] if "push" in pilot.can else None,
            "keys": [[" ".join(binding.keys), binding.text] for binding in pilot.bindings],
            "help": pilot.help,
        }

    # ---- ImGui

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
        command = self._command(moment)
        ui.SeparatorText("command")
        if not pilot.table:
            ui.Text(NO_COMMANDS)
        for index, each in enumerate(pilot.table):
            ui.SetNextItemWidth(0.62 * WIDTH)
            changed, value = ui.SliderFloat(with_units([each]), float(command[index]), each.low, each.high, "%.2f")
            if changed:
                self.steer(index, value)

    def _command(self, moment: Moment) -> FloatArray:
        """The command (C,) of the followed robot as a copy: the user's, or the task's own."""
        return np.array(self.pilot.command if self.pilot.driving else moment.commands[moment.world])

    def _buttons(self) -> None:
        ui, pilot = self.ui, self.pilot
        ui.SeparatorText("robot")
        for whole, row in zip(BUTTONS, self._rows(), strict=True):
            size = ui.Vec2(0.94 * WIDTH / len(whole) - 6, 0)
            for place, (action, label) in enumerate(row):
                if place:
                    ui.SameLine()
                if ui.Button(f"{self._words(action, label)}###{action}", size):  # ImGui's ID is after ###
                    self.click(action)
        ui.SetNextItemWidth(0.62 * WIDTH)
        if "push" in pilot.can:
            pilot.push_speed = ui.SliderFloat("push [m/s]", pilot.push_speed, 0.0, PUSH_MAX, "%.1f")[1]
        if pilot.num_worlds > 1 and ui.Checkbox("drive all robots", pilot.everyone)[0]:
            pilot.ask("everyone")

    def _rows(self) -> list[list[tuple[str, str]]]:
        """The rows of BUTTONS, with the pilot's available actions only."""
        can = self.pilot.can - (set() if self.pilot.num_worlds > 1 else {"next"})
        return [[(action, label) for action, label in row if action in can] for row in BUTTONS]

    def _words(self, action: str, label: str) -> str:
        """The current text of a button."""
        pilot = self.pilot
        words = {
            **pilot.words,
            "pause": "Go on" if pilot.paused else "Pause",
            "slower": f"Speed x {pilot.speed:g}",
            "camera": f"View: {pilot.camera}",
        }
        return words.get(action, label)

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
