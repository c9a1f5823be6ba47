"""Figures of the arena, seen from above: paths of drones, and where drones spend their time."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from typing import Any

import matplotlib
import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.collections import PatchCollection
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.layout_engine import ConstrainedLayoutEngine
from matplotlib.patches import Circle, Patch, Rectangle
from matplotlib.ticker import MaxNLocator, PercentFormatter

from uavnav import style
from uavnav.report.configurations import MODE
from uavnav.stats import Array
from uavnav.tasks.world import World


@matplotlib.rc_context(style.STYLE)
def trajectories(
    tables: Mapping[str, pd.DataFrame],
    all_layouts: Array,
    layouts: Sequence[int],
    world: World,
    width: float = style.WIDTH,
) -> style.Drawn:
    """Sampled paths of each configuration's first seed, as the paper's figures 6 and 7: a row a layout.

    tables: label -> rows of `behaviour.COLUMNS`; all_layouts: [L, K, 3] px; layouts: places in them;
    width: [inches].
    """
    of_mode = {name: rows[rows["mode"] == MODE] for name, rows in tables.items()}
    one = {name: rows[rows["seed"] == rows["seed"].min()] for name, rows in of_mode.items()}
    if not layouts or not any(len(rows) for rows in one.values()):
        return style.nothing(f"Paths of drones, {MODE}")
    height = len(layouts) * ((width - 0.5) / len(one) * world.height / world.width + 0.27) + 0.45 + 0.5
    figure = Figure(figsize=(width, height), layout=ConstrainedLayoutEngine(w_pad=0.04, h_pad=0.04))
    panels = figure.subplots(len(layouts), len(one), squeeze=False)
    said = []
    for column, (name, (colour, _)) in zip(panels.T, style.of_activations(one).items(), strict=True):
        rows, ends = one[name], []
        for axes, layout in zip(column, layouts, strict=True):
            _arena(axes, all_layouts[layout], world)
            path = rows[rows["layout"] == layout].sort_values("step")
            x, y = ([start, *path[axis]] for start, axis in zip(world.start, "xy", strict=True))
            crashed = len(path) > 0 and path["clearance"].iloc[-1] <= world.drone_radius
            axes.plot(x, y, color=colour, linewidth=1.6, solid_joinstyle="round")
            axes.plot(*world.start, "^", color=style.INK, markersize=6)
            axes.add_patch(
                Circle((x[-1], y[-1]), world.drone_radius, facecolor=colour, alpha=0.35, linewidth=0)
            )
            axes.plot(
                x[-1], y[-1], "X" if crashed else "o", color=colour, markeredgecolor=style.INK, markersize=7
            )
            axes.set_xlabel(f"{len(path)} steps" if len(path) else "no episode", fontsize=11, labelpad=2)
            ends.append(f"{len(path)} {'crash' if crashed else 'no crash'}" if len(path) else "no episode")
        seeds = f", seed {rows['seed'].iloc[0]}" if len(rows) else ""
        title = [*textwrap.wrap(style.spelled(name), int(9 * width) // len(one)), seeds[2:]]
        column[0].set_title("\n".join(title), fontsize=11)
        said.append(f"{name}{seeds}: {', '.join(ends)}")
    for axes, layout in zip(panels[:, 0], layouts, strict=True):
        axes.set_ylabel(f"layout {layout}", fontsize=11)
    handles = [
        style.mark("^", "start"),
        style.mark("X", "crash", markerfacecolor=style.PALE, markersize=8),
        style.mark("o", "no crash", markerfacecolor=style.PALE, markersize=7),
        Patch(color=style.OBSTACLE, label="obstacle"),
    ]
    style.legend(figure, handles, 4)
    shown = ", ".join(map(str, layouts))
    return style.Drawn(
        figure, f"Paths of drones, {MODE}, and their steps on layouts {shown}: {'; '.join(said)}."
    )


def _arena(axes: Axes, obstacles: Array, world: World) -> None:
    """The border and a layout [K, 3], to scale."""
    width, height, border = world.width, world.height, world.border
    circles = [Circle((x, y), radius) for x, y, radius in obstacles]
    axes.add_collection(PatchCollection(circles, color=style.OBSTACLE, linewidth=0))
    walls = [(0, 0, width, border), (0, height - border, width, border), (0, 0, border, height)]
    for x, y, across, up in [*walls, (width - border, 0, border, height)]:
        axes.add_patch(Rectangle((x, y), across, up, color="#545860", linewidth=0))
    axes.set(xlim=(0, width), ylim=(0, height), aspect="equal", xticks=[], yticks=[])
    axes.grid(visible=False)
    axes.spines[:].set_visible(False)


@matplotlib.rc_context(style.STYLE)
def preview(
    title: str, paths: Mapping[str, Array], collided: set[str], obstacles: Array, world: World
) -> Figure:
    """What a link to the page shows, 1200 x 630 px: a sentence above drones on the same obstacles [K, 3] px.

    paths: name -> where it flew [T, 2] px; collided: those whose path ends in a collision, with a cross.
    """
    figure = Figure(figsize=(12, 6.3), dpi=100)
    figure.text(
        0.03,
        0.93,
        textwrap.fill(title, 44, break_on_hyphens=False),
        fontsize=30,
        weight="bold",
        color=style.INK,
        va="top",
    )
    for place, (name, path) in enumerate(paths.items()):
        axes = figure.add_axes((0.03 + 0.32 * place, 0.06, 0.3, 0.52))
        _arena(axes, obstacles, world)
        colour = style.of_pilot(name)
        axes.plot(*path.T, color=colour, linewidth=2.5)
        shade = 0.35 if name in collided else 1.0
        axes.add_patch(Circle(tuple(path[-1]), world.drone_radius, facecolor=colour, alpha=shade, zorder=3))
        if name in collided:
            axes.plot(*path[-1], "x", color=colour, markersize=18, markeredgewidth=4, zorder=4)
        axes.set_title(name, fontsize=18, color=colour, weight="bold")
    return figure


@matplotlib.rc_context(style.STYLE)
def heat_maps(maps: Mapping[str, Array], world: World, width: float = style.WIDTH) -> style.Drawn:
    """Where the configurations fly: a panel each, one scale of colours (its square root shows rare places).

    maps: label -> shares of steps [rows of y, columns of x], from the lower-left corner; width: [inches].
    """
    title = "Where the configurations fly"
    if not maps or not any(np.nansum(share) > 0 for share in maps.values()):
        return style.nothing(title)
    height = (width - 0.8) / len(maps) * world.height / world.width + 0.25 + 1.25
    figure = Figure(figsize=(width, height), layout="constrained")
    panels = figure.subplots(1, len(maps), squeeze=False, sharey=True)[0]
    norm, said = PowerNorm(0.5, 0, max(float(np.nanmax(share)) for share in maps.values())), []
    for axes, (name, share) in zip(panels, maps.items(), strict=True):
        image = axes.imshow(
            share, origin="lower", extent=(0, world.width, 0, world.height), norm=norm, cmap="viridis"
        )
        axes.plot(*world.start, "^", color="white", markeredgecolor=style.INK, markersize=7)
        axes.grid(visible=False)
        axes.set(xticks=range(0, world.width, world.width // 4), yticks=[0, world.height // 2, world.height])
        axes.set(title=name, xlabel="x [px]")
        ordered = np.sort(np.nan_to_num(share), axis=None)[::-1].cumsum()
        half = (int(np.searchsorted(ordered, ordered[-1] / 2 - 1e-9)) + 1) / share.size
        said.append(f"{name} {100 * half:.0f} %")
    panels[0].set_ylabel("y [px]")
    rows, across = next(iter(maps.values())).shape
    label = (
        f"share of steps in {world.width / across:.0f} x {world.height / rows:.0f} px (triangle: the start)"
    )
    ticks = MaxNLocator(5 if width >= style.WIDTH else 3)
    look: dict[str, Any] = {"location": "bottom", "fraction": 0.05, "aspect": 50, "ticks": ticks}
    figure.colorbar(image, ax=panels, label=label, format=PercentFormatter(1.0), **look)
    return style.Drawn(
        figure, f"{title}: half of the steps fall into this share of the window: {', '.join(said)}."
    )
