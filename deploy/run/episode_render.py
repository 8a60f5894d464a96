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

from brakeline.actors.decision_guard import Ask
from brakeline.actors.episode_runner import EpisodeRunner
from brakeline.logs.decision_explanation import Explanation
from brakeline.logs.decision_view import DecisionView, decision_view
from brakeline.logs.episode_stats import KINDS as DECISIONS
from brakeline.logs.viewer import hex_color
from brakeline.messaging import brakeline_pb2 as pb
from brakeline.messaging.obstacle import BOX, WALL, Obstacle
from brakeline.messaging.robot import Array, Robot
from brakeline.safety.perception.displayed_map import DisplayedMap
from brakeline.sim.scripted_policies import Policy

KINDS = {pb.UNKNOWN: "no filter", **DECISIONS}
COLOURS = {kind: hex_color(kind) for kind in ("allowed", "adjusted", "failsafe", "recovering")}
COLOURS["no filter"] = hex_color("unfiltered")
ARROWS = {"proposed": hex_color("proposed"), "executed": hex_color("executed")}
EDGE = hex_color("halfspace")  # of the half-space that blocks the proposal
HITS = 400  # scan hits in one frame
FREE, HIT, MOVER = map(hex_color, ("free", "hit", "mover"))  # perceived surroundings: scan and moving obstacles
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
        view: the tube, the explanation of the decision, and the perceived surroundings.
    """

    position: Array
    heading: float
    kind: str
    view: DecisionView

    @property
    def boxes(self) -> tuple[Array, Array]:
        """The least and the greatest corners (N, d) of the tube's boxes, m; N = 0 without a tube."""
        return self.view.centers - self.view.half_widths, self.view.centers + self.view.half_widths


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


def record(driver: EpisodeRunner, policy: Policy, ask: Ask | None, number: int) -> Film:
    """Run episode `number` and return its frames."""
    driver.begin(number)
    robot, frames, step = driver.robot, list[Frame](), pb.Step()
    while driver.running:
        proposal = np.asarray(policy(driver.observation, driver.info), dtype=float)
        exchange = pb.Exchange(request=driver.request(proposal))
        outcome = driver.decide(proposal, ask)
        if outcome is not None and outcome.answer is not None and outcome.reply is not None:
            exchange.reply.CopyFrom(outcome.reply)
        before = np.asarray(driver.info["true_state"])
        step = driver.execute(proposal, outcome)
        heading = 0.0 if robot.heading is None else float(before[robot.heading])
        kind = KINDS.get(step.decision, "no filter")
        frames.append(Frame(before[: robot.position_dim], heading, kind, decision_view(robot, exchange)))
    touched = step.contact_moving or step.contact_standing
    end = "goal" if step.goal else "collision" if step.collision else "run into" if touched else "out of time"
    return Film(robot, driver.info["arena"], frames, np.asarray(step.true_state[: robot.position_dim]), end)


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
    still = path.suffix == ".png"
    figure = Figure(figsize=(7.0 * len(films), 7.4 if still else 8.2), layout="constrained" if still else None)
    panels = [_FilmAxes(film, axes) for film, axes in zip(films, np.ravel(figure.subplots(1, len(films))), strict=True)]
    if still:
        for panel in panels:
            panel.all_at_once()
        figure.savefig(path, dpi=130)
        return
    if not panels[0].flies:  # a color bar has a place of its own
        figure.subplots_adjust(left=0.01, right=0.99, bottom=0.01, top=0.85, wspace=0.04)
    for panel in panels:
        panel.zoom(np.concatenate([panel.path for panel in panels]))
    last = max(len(film.frames) for film in films)
    writer = _writer(path, round(SPEED / films[0].robot.period))
    with writer.saving(figure, str(path), dpi=100 // len(films)):
        for k in range(last + 1):
            for panel in panels:
                panel.show(k)
            for _ in range(1 if k < last else LAST_FRAMES):
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
        self._font, self._width = 10, 80  # of the title: size, and characters in a line

    def _room(self) -> None:
        axes, arena = self.axes, self.film.arena
        (left, right), (bottom, top) = arena.bounds[:2]
        edge = 0.03 * (right - left)
        axes.add_patch(Rectangle((left, bottom), right - left, top - bottom, fill=False, linewidth=2.0, zorder=1))
        axes.set(
            xlim=(left - edge, right + edge),
            ylim=(bottom - edge, top + edge),
            aspect="equal",
            xlabel="x [m]",
            ylabel="y [m]",
        )
        covers = [o for o in arena.obstacles if o.kind == BOX and o.size[0] >= right - left]  # floor and ceiling
        inside = [o for o in arena.obstacles if o.kind != WALL and o not in covers]
        drawn = PatchCollection([_patch(o) for o in inside], edgecolor="#333333", linewidth=0.8, zorder=2)
        if self.flies:
            drawn.set_array(np.array([_top(o) for o in inside]))
            drawn.set(cmap=HEIGHTS, clim=arena.bounds[2], alpha=0.45)
            label = "height of the path and of the tops of obstacles [m]"
            axes.figure.colorbar(drawn, ax=axes, label=label, shrink=0.7)
        else:
            drawn.set_facecolor("#9a9a9a")
        axes.add_collection(drawn)
        goal = arena.goal
        axes.add_patch(Circle(goal[:2], arena.goal_radius, color=hex_color("goal"), alpha=0.35, zorder=1))
        axes.plot(*goal[:2], marker="*", color=hex_color("goal"), markersize=12, zorder=3)
        axes.plot(*self.path[0, :2], marker="o", color="white", markeredgecolor="black", markersize=6, zorder=6)

    def zoom(self, paths: Array) -> None:
        """Show the part of the room that holds these positions (k, d) and the goal, and enlarge the text for a film."""
        goal, radius = np.array(self.film.arena.goal[:2]), self.film.arena.goal_radius
        points = np.concatenate([paths[:, :2], [goal - radius, goal + radius]])
        middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
        half = 0.5 * float((points.max(axis=0) - points.min(axis=0)).max()) + 3.0 * self.robot.footprint
        self.axes.set(
            xlim=(middle[0] - half, middle[0] + half),
            ylim=(middle[1] - half, middle[1] + half),
            xlabel="",
            ylabel="",
            xticks=[],
            yticks=[],
        )
        self._font, self._width = 19, 44

    def show(self, k: int) -> None:
        """Draw the start of period k with its plan; after the last period, the whole path and the outcome."""
        for artist in self._moving:
            artist.remove()
        frames = self.film.frames
        self._draw_path(min(k, len(frames)))
        if k >= len(frames):
            self._moving = self._body(self.film.last, frames[-1].heading, frames[-1].kind)
            if self.film.end == "collision":
                self._moving += self.axes.plot(*self.film.last[:2], "x", color=EDGE, markersize=18, mew=4, zorder=10)
            return self._title(len(frames), self.film.end)
        frame, explained = frames[k], frames[k].view.explanation if len(frames[k].view.centers) else None
        self._moving = [
            *self._draw_perceived(frame.view.perceived),
            *self._tube(frame, 0.35),
            *self._body(frame.position, frame.heading, frame.kind),
            *self._line([frame.position, *frame.view.centers], color=COLOURS[frame.kind], linewidth=1.2, zorder=5),
            *([] if explained is None else self._draw_explanation(frame, explained)),
        ]
        if explained is None or frame.kind == "allowed":
            return self._title(k, frame.kind)
        return self._title(k, textwrap.fill(f"{frame.kind}: {explained.sentence}", self._width))

    def _title(self, k: int, sentence: str) -> None:
        title = f"{self._name()}{k * self.robot.period:5.1f} s\n{sentence}"
        self.axes.set_title(title, fontsize=self._font, loc="left")

    def _line(self, points: Sequence[Array], **style: Any) -> list[Any]:
        """Draw a line through points, from above."""
        return list(self.axes.plot(*np.stack([point[:2] for point in points]).T, **style))

    def _draw_explanation(self, frame: Frame, why: Explanation) -> list[Any]:
        """Draw the proposed and the executed input, and the edge of the half-space that blocks the proposal."""
        drawn: list[Any] = []
        for label, way in (("proposed", why.proposed), ("executed", why.executed)):
            style: dict[str, Any] = {"width": 0.12 * self.robot.footprint, "color": ARROWS[label], "zorder": 9}
            arrow = FancyArrow(*frame.position[:2], *way[:2], length_includes_head=True, **style)
            drawn.append(self.axes.add_patch(arrow))
        flat = float(np.hypot(*why.normal[:2])) if len(why.at) else 0.0
        if flat > 0.2 and frame.kind != "allowed":
            along = 3.0 * self.robot.footprint * np.array([-why.normal[1], why.normal[0]]) / flat
            drawn += self._line([why.at[:2] - along, why.at[:2] + along], color=EDGE, linewidth=2.5, zorder=9)
        return drawn

    def _draw_perceived(self, about: DisplayedMap | None, alpha: float = 1.0) -> list[Any]:
        """Draw scan hits, free space, and moving obstacles with the sets that they can reach during the plan."""
        drawn: list[Any] = []
        if about is None:
            return drawn
        if len(about.free):
            outline = Polygon(about.free[:, :2], facecolor=FREE, edgecolor=FREE, alpha=0.12 * alpha, zorder=1)
            drawn.append(self.axes.add_patch(outline))
            hits = np.array([hit[:2] for hit in about.flat(HITS)["hits"]]).reshape(-1, 2)
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
            self._draw_perceived(frames[k].view.perceived, 0.2)
            self._tube(frames[k], 0.18)
            self._body(frames[k].position, frames[k].heading, frames[k].kind, alpha=0.25)
        self._body(self.film.last, frames[-1].heading, frames[-1].kind)
        self._draw_path(len(frames))
        shares = {kind: float(np.mean([frame.kind == kind for frame in frames])) for kind in COLOURS}
        shown = ", ".join(f"{100 * share:.0f} % {kind}" for kind, share in shares.items() if share >= 0.005)
        time = f"{len(frames) * self.robot.period:.1f} s"
        self.axes.set_title(f"{self._name()}{self.film.end} after {time}; {shown}", fontsize=11, loc="left")
        if not self.flies:
            handles = [Patch(color=COLOURS[kind], label=kind) for kind, share in shares.items() if share]
            style: dict[str, Any] = {"fontsize": 8, "frameon": False, "bbox_to_anchor": (1.0, 1.0)}
            self.axes.legend(handles=handles, loc="upper right", ncols=len(handles), **style)

    def _name(self) -> str:
        unfiltered = all(frame.kind == "no filter" for frame in self.film.frames)
        return f"{self.robot.name}, {self.film.arena.name}, {'without' if unfiltered else 'with'} the filter: "

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
        rounded = f"Round, pad={self.robot.footprint}, rounding_size={self.robot.footprint}"
        style: dict[str, Any] = {"boxstyle": rounded, "color": COLOURS[frame.kind], "alpha": alpha}
        boxes = [
            FancyBboxPatch(low[:2], *(high - low)[:2], linewidth=0, zorder=3, **style)
            for low, high in zip(*frame.boxes, strict=True)
        ]
        return [self.axes.add_patch(box) for box in boxes]

    def _body(self, position: Array, heading: float, kind: str, alpha: float = 1.0) -> list[Any]:
        """Draw the discs of the body and a line to its front."""
        turn = np.array([[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]])
        style: dict[str, Any] = {"facecolor": COLOURS[kind], "edgecolor": "black", "alpha": alpha, "zorder": 7}
        circles = [Circle(tuple(position[:2] + turn @ disc.at[:2]), disc.radius, **style) for disc in self.robot.body]
        drawn: list[Any] = [self.axes.add_patch(circle) for circle in circles]
        if self.robot.heading is not None:
            nose = position[:2] + self.robot.front_extent * turn[:, 0]
            drawn += self._line([position, nose], color="white", linewidth=1.5, alpha=alpha, zorder=8)
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
