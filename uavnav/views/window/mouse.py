"""What the mouse does while obstacles are drawn in the live window."""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from uavnav.tasks import layouts as splits
from uavnav.views.window.game import Game


def grab(game: Game, x: float, y: float) -> Game:
    """The left button went down at a place of the world [px]: there is the obstacle's centre."""
    inside = 0 <= x <= game.world.width and 0 <= y <= game.world.height
    if not game.drawing or not inside:
        return game
    return replace(game, message="", circle=(x, y, game.world.obstacle_radius_min))


def drag(game: Game, x: float, y: float) -> Game:
    """The mouse moved with the button down: there is the obstacle's edge."""
    if game.circle is None:
        return game
    left, bottom, _ = game.circle
    radius = math.hypot(x - left, y - bottom)
    radius = min(max(radius, game.world.obstacle_radius_min), game.world.obstacle_radius_max)
    return replace(game, circle=(left, bottom, radius))


def drop(game: Game) -> Game:
    """The button went up: the obstacle is there, if a layout file may have it."""
    if game.circle is None:
        return game
    if refused := problem(game):
        return replace(game, circle=None, message=refused)
    return replace(game, circle=None, obstacles=_with(game), own=True)


def problem(game: Game) -> str:
    """Why the obstacle under the mouse cannot be there; empty if it can."""
    try:
        splits.resolve(_with(game), game.world)
    except splits.LayoutError as error:
        return f"Not there: {error}"
    return ""


def _with(game: Game) -> Tensor:
    """The layout with the circle under the mouse, which stands still where others move."""
    circle = torch.zeros(1, 1, game.obstacles.shape[-1])
    circle[..., :3] = torch.tensor(game.circle)
    return torch.cat([game.obstacles, circle], dim=1)


def erase(game: Game, x: float, y: float) -> Game:
    """The right button: take away the last obstacle that covers this place of the world [px]."""
    circles = game.obstacles[0]
    covering = (torch.hypot(circles[:, 0] - x, circles[:, 1] - y) <= circles[:, 2]).nonzero()
    if not game.drawing or not len(covering):
        return game
    kept = torch.arange(len(circles)) != covering[-1]
    return replace(game, obstacles=game.obstacles[:, kept], own=True, message="")
