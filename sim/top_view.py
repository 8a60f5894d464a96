"""Draw an arena and its robot from above, as an image, with NumPy alone."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from brakeline.messaging.obstacle import Array, Shapes, rotate
from brakeline.messaging.robot import Robot
from brakeline.sim.arena import Arena
from brakeline.sim.grid_planner import nearest_distances

Image = NDArray[np.uint8]

PIXELS = 360  # along the longer side of the room
FREE, OBSTACLE, GOAL = (255, 255, 255), (110, 110, 110), (150, 210, 150)
MOVER, ROBOT, HEADING = (230, 140, 30), (40, 90, 200), (255, 255, 255)


class TopView:
    """A view of one arena from above: x to the right, y up.

    An arena in space is cut at the height of the robot.
    """

    def __init__(self, robot: Robot, arena: Arena) -> None:
        """Draw the map once if it is the same at all heights. The longer side of the room has `PIXELS` pixels."""
        self._robot, self._arena = robot, arena
        (left, right), (bottom, top) = arena.bounds[:2]
        pixel = max(right - left, top - bottom) / PIXELS  # m
        x: Array = left + pixel * (np.arange(round((right - left) / pixel), dtype=np.float64) + 0.5)
        y: Array = top - pixel * (np.arange(round((top - bottom) / pixel), dtype=np.float64) + 0.5)
        self._points: Array = np.stack(np.meshgrid(x, y), axis=-1)  # (H, W, 2)
        self._background = self._draw_map(0.0) if arena.dim == 2 else None

    def draw(self, state: Array, time: float) -> Image:
        """Return the image (H, W, 3) of the room with the robot in a state (n,), at a time [s] of the episode."""
        height = float(state[2]) if self._arena.dim == 3 else 0.0
        image = self._draw_map(height) if self._background is None else self._background.copy()
        if self._arena.crowd is not None:
            self._paint(image, MOVER, Shapes.of(self._arena.crowd.obstacles(time), self._arena.dim), height)
        heading = 0.0 if self._robot.heading is None else float(state[self._robot.heading])
        for disc in self._robot.body:
            centre = state[:2] + rotate(np.array(disc.at[:2]), heading)
            image[self._distance_to(centre) <= disc.radius] = ROBOT
        if self._robot.heading is not None:
            ahead = np.array([math.cos(heading), math.sin(heading)])
            offset = self._points - state[:2]
            along, across = offset @ ahead, np.abs(offset @ np.array([-ahead[1], ahead[0]]))
            image[(along >= 0.0) & (along <= self._robot.footprint) & (across <= 0.1 * self._robot.footprint)] = HEADING
        return image

    def _draw_map(self, height: float) -> Image:
        """Draw the goal and the obstacles, at a height [m]."""
        image = np.full((*self._points.shape[:2], 3), FREE, np.uint8)
        image[self._distance_to(np.array(self._arena.goal[:2])) <= self._arena.goal_radius] = GOAL
        self._paint(image, OBSTACLE, self._arena.shapes, height)
        return image

    def _paint(self, image: Image, colour: tuple[int, int, int], shapes: Shapes, height: float) -> None:
        points = self._points.reshape(-1, 2)
        if self._arena.dim == 3:
            points = np.column_stack((points, np.full(len(points), height)))
        image[nearest_distances(shapes, points).reshape(image.shape[:2]) <= 0.0] = colour

    def _distance_to(self, point: Array) -> Array:
        return np.asarray(np.linalg.norm(self._points - point, axis=-1))


class Window:
    """A matplotlib window that shows one image after another."""

    def __init__(self, title: str) -> None:
        from matplotlib import pyplot

        self._pyplot = pyplot
        self._figure = pyplot.figure(title)
        self._axes = self._figure.add_axes((0.0, 0.0, 1.0, 1.0), frameon=False)
        self._axes.set_axis_off()
        if self._figure.canvas.manager is not None:
            self._figure.canvas.manager.show()

    def show(self, image: Image) -> None:
        """Replace the image, and let the window handle its events."""
        for old in self._axes.images:
            old.remove()
        self._axes.imshow(image)
        self._figure.canvas.draw_idle()
        self._figure.canvas.flush_events()

    def close(self) -> None:
        self._pyplot.close(self._figure)
