"""Render an episode from above as a picture or a film: obstacles, path, plan and tube.

For a robot in space, colours show heights.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.animation import AbstractMovieWriter, FFMpegWriter, PillowWriter
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PatchCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle, FancyArrow, FancyBboxPatch, Patch, Polygon, Rectangle
from matplotlib.transforms import Affine2D
from numpy.typing import NDArray

from brakeline.actors.decision_guard import Ask, request_decisions
from brakeline.actors.episode_runner import EpisodeRunner
from brakeline.logs.decision_explanation import Explanation
from brakeline.logs.decision_view import decision_view
from brakeline.logs.episode_stats import KINDS as DECISIONS
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import BOX, WALL, Obstacle
from brakeline.messaging.robot import Robot
from brakeline.safety.perception.displayed_map import DisplayedMap
from brakeline.sim.scripted_policies import Policy

Array = NDArray[np.float64]

KINDS = {pb.UNKNOWN: "no filter", **DECISIONS}
COLOURS = {"no filter": "#444444", "allowed": "#0072b2", "adjusted": "#e69f00", "failsafe": "#d55e00"}
COLOURS["recovering"] = "#8e44ad"
ARROWS = {"proposed": "#c77d00", "executed": "#1f5fbf"}
EDGE = "#c02030"  # of the half-space that blocks the proposal
HITS = 400  # scan hits in one frame
FREE, HIT, MOVER = "#148c78", "#5a288c", "#aa5a28"  # perceived surroundings: scan and moving obstacles
FORMATS = (".png", ".gif", ".mp4")
SPEED = 3.0  # of the film relative to real time
LAST_FRAMES = 8  # repetitions of the last frame
HEIGHTS = "viridis"


@dataclass(frozen=True)
class Frame:
    """One period of an episode.

    Attributes:
        position: (d,), true position at the start of the period, m; heading: rad.
        kind: of decision.
        low, high, center: (N, d), corners and centers of the tube's boxes, m; N = 0 without a tube.
        margin: from the tube to the edge of free space, m.
        why: the explanation of the decision; None without one.
        around: the perceived surroundings.
    """

    position: Array
    heading: float
    kind: str
    low: Array
    high: Array
    center: Array
    margin: float
    why: Explanation | None = None
    around: DisplayedMap | None = None


@dataclass(frozen=True)
class Film:
    """An episode, frame by frame.

    Attributes:
        last: (d,), the last position, m.
        end: the outcome.
    """

    robot: Robot
    arena: Any
    frames: list[Frame]
    last: Array
    end: str


def record(driver: EpisodeRunner, policy: Policy, question: Ask | None, number: int) -> Film:
    """Run episode `number` and return its frames."""
    driver.begin(number)
    d = driver.robot.position_dim
    frames, step = [], pb.Step()
    while driver.running:
        proposal = np.asarray(policy(driver.observation, driver.info), dtype=float)
        request = driver.request(proposal)
        outcome = request_decisions(question, [request], driver.robot)[0] if question is not None else None
        reply = pb.Reply()
        if outcome is not None and outcome.answer is not None and outcome.reply is not None:
            reply = outcome.reply
        before = np.asarray(driver.info["true_state"])
        step = driver.execute(proposal, outcome)
        heading = 0.0 if driver.robot.heading is None else float(before[driver.robot.heading])
        kind = KINDS.get(step.decision, "no filter")
        view = decision_view(driver.robot, pb.Exchange(request=request, reply=reply))
        boxes = view.centers - view.half_widths, view.centers + view.half_widths, view.centers
        why = view.explanation if len(view.centers) else None
        frames.append(Frame(before[:d], heading, kind, *boxes, reply.decision.margin, why, view.perceived))
    touched = step.contact_moving or step.contact_standing
    end = "goal" if step.goal else "collision" if step.collision else "run into" if touched else "out of time"
    return Film(driver.robot, driver.info["arena"], frames, np.asarray(step.true_state[:d]), end)


def check_ending(path: Path) -> None:
    """Raise ValueError unless the file name has the ending of a picture or a film."""
    if path.suffix not in FORMATS:
        raise ValueError(f"{path}: the name must end in {', '.join(FORMATS)}")


def save(films: Sequence[Film], path: Path) -> None:
    """Draw films side by side, as one picture of all frames (.png) or as a film (.gif, .mp4).

    Raises:
        ValueError: the file name has another ending.
    """
    check_ending(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    figure = Figure(figsize=(7.0 * len(films), 7.4), layout="constrained")
    panels = [_FilmAxes(film, axes) for film, axes in zip(films, np.ravel(figure.subplots(1, len(films))), strict=True)]
    if path.suffix == ".png":
        for panel in panels:
            panel.all_at_once()
        figure.savefig(path, dpi=130)
        return
    dpi, last = 90 // len(films), max(len(film.frames) for film in films)
    with (writer := _writer(path, round(SPEED / films[0].robot.period))).saving(figure, str(path), dpi=dpi):
        for k in range(last):
            for panel in panels:
                panel.show(k)
            writer.grab_frame()
        for panel in panels:
            panel.ended()
        for _ in range(LAST_FRAMES):
            writer.grab_frame()


def _writer(path: Path, rate: int) -> AbstractMovieWriter:
    if path.suffix == ".gif":
        return PillowWriter(fps=rate)
    import imageio_ffmpeg
    import matplotlib

    matplotlib.rcParams["animation.ffmpeg_path"] = imageio_ffmpeg.get_ffmpeg_exe()
    return FFMpegWriter(fps=rate, codec="h264", extra_args=["-pix_fmt", "yuv420p", "-crf", "20"])


class _FilmAxes:
    """The axes of one film: the fixed arena and the artists of the current frame."""

    def __init__(self, film: Film, axes: Axes) -> None:
        self.film, self.robot = film, film.robot
        self.flies = film.robot.position_dim == 3
        self.axes = axes
        self.path = np.array([frame.position for frame in film.frames] + [film.last])
        self._room()
        self.lines = LineCollection([], linewidths=2.2, zorder=4)
        self.axes.add_collection(self.lines)
        self._moving: list[Any] = []

    def _room(self) -> None:
        axes, arena = self.axes, self.film.arena
        (left, right), (bottom, top) = arena.bounds[:2]
        edge = 0.03 * (right - left)
        axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, fill=False, linewidth=2.0, zorder=1))
        axes.set(xlim=(left - edge, right + edge), ylim=(bottom - edge, top + edge), aspect="equal")
        axes.set_xlabel("x [m]")
        axes.set_ylabel("y [m]")
        inside = [o for o in arena.obstacles if o.kind != WALL and not self._closes(o)]
        drawn = PatchCollection([_patch(o) for o in inside], edgecolor="#333333", linewidth=0.8, zorder=2)
        if self.flies:
            drawn.set_array(np.array([_top(o) for o in inside]))
            drawn.set(cmap=HEIGHTS, clim=arena.bounds[2], alpha=0.45)
            axes.figure.colorbar(
                drawn, ax=axes, label="height of the path and of the tops of obstacles [m]", shrink=0.7
            )
        else:
            drawn.set_facecolor("#9a9a9a")
        axes.add_collection(drawn)
        goal = arena.goal
        axes.add_patch(Circle(goal[:2], arena.goal_radius, color="#009e73", alpha=0.35, zorder=1))
        axes.plot(*goal[:2], marker="*", color="#009e73", markersize=12, zorder=3)
        axes.plot(*self.path[0, :2], marker="o", color="white", markeredgecolor="black", markersize=6, zorder=6)

    def _closes(self, obstacle: Obstacle) -> bool:
        """Return whether the obstacle is a floor or a ceiling."""
        (left, right), _ = self.film.arena.bounds[:2]
        return obstacle.kind == BOX and obstacle.size[0] >= right - left

    def show(self, k: int) -> None:
        """Draw the start of period k with its plan; after the last period, the outcome."""
        if k >= len(self.film.frames):
            return self.ended()
        frame = self.film.frames[k]
        for artist in self._moving:
            artist.remove()
        self._moving = [
            *self._draw_perceived(frame.around),
            *self._tube(frame, 0.35),
            *self._body(frame.position, frame.heading, frame.kind),
        ]
        if len(frame.center):
            points = np.vstack([frame.position, frame.center])
            self._moving += self.axes.plot(
                points[:, 0], points[:, 1], color=COLOURS[frame.kind], linewidth=1.2, zorder=5
            )
        self._draw_path(k)
        said = frame.kind
        if frame.why is not None:
            self._moving += self._draw_explanation(frame, frame.why)
            said = frame.kind if frame.kind == "allowed" else textwrap.fill(f"{frame.kind}: {frame.why.said}", 80)
        self.axes.set_title(f"{self._heading()}{k * self.robot.period:5.1f} s\n{said}", fontsize=10, loc="left")

    def ended(self) -> None:
        """Draw the whole path and the outcome."""
        for artist in self._moving:
            artist.remove()
        frames = self.film.frames
        self._moving = self._body(self.film.last, frames[-1].heading, frames[-1].kind)
        if self.film.end == "collision":
            self._moving += self.axes.plot(*self.film.last[:2], marker="x", color=EDGE, markersize=18, mew=4, zorder=10)
        self._draw_path(len(frames))
        seconds = len(frames) * self.robot.period
        self.axes.set_title(f"{self._heading()}{seconds:5.1f} s\n{self.film.end}", fontsize=10, loc="left")

    def _draw_explanation(self, frame: Frame, why: Explanation) -> list[Any]:
        """Draw the proposed and the executed input, and the edge of the half-space that blocks the proposal."""
        drawn: list[Any] = []
        x, y = frame.position[:2]
        for label, way in (("proposed", why.proposed), ("executed", why.executed)):
            wide = 0.12 * self.robot.footprint
            arrow = FancyArrow(
                x, y, way[0], way[1], width=wide, length_includes_head=True, color=ARROWS[label], zorder=9
            )
            drawn.append(self.axes.add_patch(arrow))
        flat = float(np.hypot(*why.normal[:2])) if len(why.at) else 0.0
        if flat > 0.2 and frame.kind != "allowed":
            along = 3.0 * self.robot.footprint * np.array([-why.normal[1], why.normal[0]]) / flat
            ends = np.stack([why.at[:2] - along, why.at[:2] + along])
            drawn += self.axes.plot(ends[:, 0], ends[:, 1], color=EDGE, linewidth=2.5, zorder=9)
        return drawn

    def _draw_perceived(self, about: DisplayedMap | None, alpha: float = 1.0) -> list[Any]:
        """Draw scan hits, free space, and moving obstacles with the sets that they can reach during the plan."""
        if about is None:
            return []
        drawn: list[Any] = []
        if len(about.free):
            outline = Polygon(
                about.free[:, :2], closed=True, facecolor=FREE, edgecolor=FREE, alpha=0.12 * alpha, zorder=1
            )
            drawn.append(self.axes.add_patch(outline))
            hits = np.reshape(about.flat(HITS)["hits"], (-1, 2))
            drawn += self.axes.plot(*hits.T, ".", color=HIT, markersize=2, alpha=alpha, zorder=5)
        for discs, faint in ((about.swept.reshape(-1, about.swept.shape[-1]), 0.12), (about.movers, 0.8)):
            for disc in discs:
                circle = Circle(disc[:2], disc[-1], color=MOVER, alpha=faint * alpha, linewidth=0, zorder=3)
                drawn.append(self.axes.add_patch(circle))
        return drawn

    def all_at_once(self) -> None:
        """Draw the whole path, and tubes and bodies of some frames."""
        frames = self.film.frames
        for k in np.unique(np.linspace(0, len(frames) - 1, 16).astype(int)):
            self._draw_perceived(frames[k].around, 0.2)
            self._tube(frames[k], 0.18)
            self._body(frames[k].position, frames[k].heading, frames[k].kind, alpha=0.25)
        self._body(self.film.last, frames[-1].heading, frames[-1].kind)
        self._draw_path(len(frames))
        shares = [f"{100 * np.mean([f.kind == kind for f in frames]):.0f} % {kind}" for kind in COLOURS]
        shown = ", ".join(text for text in shares if not text.startswith("0 %"))
        time = f"{len(frames) * self.robot.period:.1f} s"
        self.axes.set_title(f"{self._heading()}{self.film.end} after {time}; {shown}", fontsize=11, loc="left")
        seen = [kind for kind in COLOURS if any(frame.kind == kind for frame in frames)]
        if not self.flies:
            handles = [Patch(color=COLOURS[kind], label=kind) for kind in seen]
            self.axes.legend(
                handles=handles,
                loc="upper right",
                fontsize=8,
                ncols=len(seen),
                frameon=False,
                bbox_to_anchor=(1.0, 1.0),
            )

    def _heading(self) -> str:
        unfiltered = all(frame.kind == "no filter" for frame in self.film.frames)
        return f"{self.robot.name}, {self.film.arena.name}{', without the filter' if unfiltered else ''}: "

    def _draw_path(self, k: int) -> None:
        """Draw the path up to period k, coloured by decision; in space, by height."""
        pieces = np.stack([self.path[:k], self.path[1 : k + 1]], axis=1)
        self.lines.set_segments(list(pieces[:, :, :2]))
        if self.flies:
            self.lines.set(array=pieces[:, :, 2].mean(axis=1), cmap=HEIGHTS, clim=self.film.arena.bounds[2])
        else:
            self.lines.set_color([COLOURS[frame.kind] for frame in self.film.frames[:k]])

    def _tube(self, frame: Frame, alpha: float) -> list[Any]:
        """Draw the tube's boxes, enlarged by the footprint."""
        drawn = []
        for low, high in zip(frame.low, frame.high, strict=True):
            size, round_off = high - low, f"Round, pad={self.robot.footprint}, rounding_size={self.robot.footprint}"
            box = FancyBboxPatch(low[:2], size[0], size[1], boxstyle=round_off, color=COLOURS[frame.kind], alpha=alpha)
            box.set(linewidth=0, zorder=3)
            drawn.append(self.axes.add_patch(box))
        return drawn

    def _body(self, position: Array, heading: float, kind: str, alpha: float = 1.0) -> list[Any]:
        """Draw the discs of the body and a line to its front."""
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        drawn: list[Any] = []
        for disc in self.robot.body:
            middle = tuple(position[:2] + turn @ disc.at[:2])
            circle = Circle(middle, disc.radius, facecolor=COLOURS[kind], edgecolor="black", alpha=alpha, zorder=7)
            drawn.append(self.axes.add_patch(circle))
        if self.robot.heading is not None:
            nose = position[:2] + self.robot.front_extent * turn[:, 0]
            line = np.stack([position[:2], nose])
            drawn += self.axes.plot(line[:, 0], line[:, 1], color="white", linewidth=1.5, alpha=alpha, zorder=8)
        return drawn


def _patch(obstacle: Obstacle) -> Patch:
    x, y = obstacle.position[:2]
    if obstacle.kind != BOX:
        return Circle((x, y), obstacle.size[0])
    corners = 0.5 * np.array([(1, 1), (-1, 1), (-1, -1), (1, -1)]) * obstacle.size[:2]
    return Polygon(Affine2D().rotate(obstacle.yaw).translate(x, y).transform(corners))


def _top(obstacle: Obstacle) -> float:
    """Return the height of an obstacle's highest point, m."""
    if len(obstacle.position) == 2:
        return 0.0
    vertical = obstacle.size[0] if obstacle.kind == "sphere" else 0.5 * obstacle.size[-1]
    return float(obstacle.position[2] + vertical)
