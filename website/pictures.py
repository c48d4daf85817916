"""The two pictures of the concepts page, in both languages: what a step does, and who imports whom.

python -m website.pictures
"""

# ruff: noqa: RUF001
# (commas of Chinese text)
from __future__ import annotations

from collections.abc import Sequence
from html import escape

from legged_mw import ROOT

IMAGES = ROOT / "docs/images"
# white text stands out on each
BLUE, GREEN, ORANGE, GREY, PURPLE = "#3b5ba9", "#2e7d5b", "#b0641a", "#5f6b7a", "#7a4a9e"
LINE = "#75808e"  # seen on white and on black
STEP: list[tuple[str, str, str, str]] = [  # colour, method, English, Chinese
    (ORANGE, "perturbation.apply()", "kicks and pushes", "扰动：推力与速度突变"),
    (GREEN, "_apply_actions()", "actions become joint targets", "动作变为关节目标"),
    (GREEN, "sim.step(decimation)", "physics, motors in the model", "物理仿真，电机在模型里"),
    (BLUE, "_update_state()", "all that rewards and rows read", "奖励与观测要读的量，只算一次"),
    (BLUE, "check_termination()", "fell, timed out, not finite", "跌倒、超时、数值发散"),
    (BLUE, "compute_reward()", "the terms that have a scale", "系数不为零的奖励项"),
    (BLUE, "_end_step()", "memory, timers, new commands", "记忆、计时、新指令"),
    (ORANGE, "statistics", "summed on the device", "在设备上累加统计量"),
    (GREEN, "reset_envs(mask)", "where an episode ended", "只重置掩码为真的环境"),
    (BLUE, "compute_observations()", "rows: noise, delay, history", "观测行：噪声、延迟、历史"),
]
WORDS = {
    "en": (
        "actions (N, D)",
        "observations, reward, dones: clones",
        "on a GPU all of this is one recorded CUDA graph, replayed every step",
    ),
    "zh": ("动作 (N, D)", "观测、奖励、终止：交出副本", "在 GPU 上，这一切是一张录制好的 CUDA graph，每一步只需重放"),
}
HOUSE: list[tuple[str, str, str, str]] = [  # of the core, from the top
    (GREY, "train.py  play.py", "main() of fifteen lines", "十几行的 main()"),
    (PURPLE, "legged_mw/rl", "PPO, runner, run folders", "PPO、训练循环、运行目录"),
    (BLUE, "legged_mw/envs", "tasks: rewards, rows, commands", "任务：奖励、观测行、指令"),
    (GREEN, "legged_mw/sim", "model, two engines, graph", "模型、两个引擎、CUDA graph"),
    (GREY, "legged_mw/utils", "config rule, command line", "配置规则、命令行"),
]
TOOLS: list[tuple[str, str, str, str]] = [
    (ORANGE, "legged_mw/eval", "exams, report", "考试与报告"),
    (ORANGE, "legged_mw/view", "window, web page, video", "窗口、网页、视频"),
    (ORANGE, "legged_mw/export, deploy", "a policy without torch", "脱离 torch 运行策略"),
    (ORANGE, "legged_mw/robot, motion", "robots and clips in", "导入机器人与动作"),
]
HOUSE_WORDS = {
    "en": (
        "the core: imports run downwards",
        "tools: import the core, never the other way",
        "configs/*.py: a task is one file; resources/: robots, policies",
    ),
    "zh": (
        "核心：import 只能自上而下",
        "工具：依赖核心，反之不行",
        "configs/*.py：一个任务一个文件；resources/：机器人与策略",
    ),
}


def text(
    x: float, y: float, words: str, size: int = 13, fill: str = "#fff", style: str = "", anchor: str = "middle"
) -> str:
    """``style``: mono, bold, or both."""
    family = (
        "ui-monospace,Menlo,Consolas,monospace"
        if "mono" in style
        else "system-ui,'Noto Sans CJK SC','Microsoft YaHei',sans-serif"
    )
    look = f'font-size="{size}" fill="{fill}" text-anchor="{anchor}" font-family="{family}" font-weight="{600 if "bold" in style else 400}"'
    return f'<text x="{x:g}" y="{y:g}" {look}>{escape(words)}</text>'


def box(x: float, y: float, width: float, height: float, colour: str, name: str, words: str) -> str:
    shape = f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="8" fill="{colour}"/>'
    middle = x + width / 2
    return (
        shape
        + text(middle, y + height / 2 - 4, name, 13, style="mono bold")
        + text(middle, y + height / 2 + 15, words, 12)
    )


def arrow(*points: tuple[float, float]) -> str:
    path = " ".join(f"{x},{y}" for x, y in points)
    return f'<polyline points="{path}" fill="none" stroke="{LINE}" stroke-width="2" marker-end="url(#head)"/>'


def svg(width: int, height: int, parts: Sequence[str], title: str) -> str:
    look = 'viewBox="0 0 8 8" refX="7" refY="4" markerWidth="8" markerHeight="8" orient="auto"'
    head = f'<marker id="head" {look}><path d="M0 0L8 4L0 8z" fill="{LINE}"/></marker>'
    start = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img"><title>{escape(title)}</title>'
    return f"{start}<defs>{head}</defs>\n" + "\n".join(parts) + "\n</svg>\n"


def frame(x: float, y: float, width: float, height: float) -> str:
    look = f'fill="none" stroke="{LINE}" stroke-width="1.5" stroke-dasharray="6 5"'
    return f'<rect x="{x}" y="{y}" width="{width}" height="{height}" rx="12" {look}/>'


def step(language: str) -> str:
    """Ten boxes in three rows, read like a page."""
    before, after, note = WORDS[language]
    width, height, left, top, gap_x, gap_y, columns = 212, 58, 30, 66, 26, 34, 4
    places = [
        (left + (i % columns) * (width + gap_x), top + (i // columns) * (height + gap_y)) for i in range(len(STEP))
    ]
    parts = [
        frame(12, 44, 956, 288),
        text(490, 352, note, 13, LINE),
        text(left, 30, before, 14, LINE, style="bold", anchor="start"),
    ]
    parts.append(arrow((left + 50, 38), (left + 50, top - 2)))
    for (x, y), (colour, name, english, chinese) in zip(places, STEP, strict=True):
        parts.append(box(x, y, width, height, colour, name, english if language == "en" else chinese))
    for (x, y), (to_x, to_y) in zip(places, places[1:], strict=False):
        if to_y == y:
            parts.append(arrow((x + width, y + height / 2), (to_x - 2, y + height / 2)))
        else:
            middle = y + height + gap_y / 2
            parts.append(
                arrow(
                    (x + width / 2, y + height),
                    (x + width / 2, middle),
                    (to_x + width / 2, middle),
                    (to_x + width / 2, to_y - 2),
                )
            )
    x, y = places[-1]
    parts += [
        arrow((x + width, y + height / 2), (x + width + 60, y + height / 2)),
        text(x + width + 70, y + height / 2 + 5, after, 14, LINE, style="bold", anchor="start"),
    ]
    return svg(980, 366, parts, note)


def house(language: str) -> str:
    """The core as a stack, the tools beside it."""
    core, tools, below = HOUSE_WORDS[language]
    which = 2 if language == "en" else 3
    width, height, gap = 400, 54, 24
    parts = [
        text(30, 28, core, 14, LINE, style="bold", anchor="start"),
        text(520, 28, tools, 14, LINE, style="bold", anchor="start"),
    ]
    for i, row in enumerate(HOUSE):
        y = 44 + i * (height + gap)
        parts.append(box(30, y, width, height, row[0], row[1], row[which]))
        if i:
            parts.append(arrow((230, y - gap), (230, y - 2)))
    for i, row in enumerate(TOOLS):
        y = 44 + (i + 0.5) * (height + gap)
        parts += [
            box(520, y, width, height, row[0], row[1], row[which]),
            arrow((520, y + height / 2), (432, y + height / 2)),
        ]
    parts.append(text(475, 44 + 5 * (height + gap) + 6, below, 13, LINE))
    return svg(950, 454, parts, core)


def main() -> None:
    for name, draw in (("step", step), ("house", house)):
        for language in ("en", "zh"):
            (IMAGES / (f"{name}.svg" if language == "en" else f"{name}.{language}.svg")).write_text(draw(language))


if __name__ == "__main__":
    main()
