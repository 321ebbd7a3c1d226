"""Layouts of arenas; each layout is a pure function.

`LAYOUTS` lists the layouts by the names that stages use for `level`. `site.py` holds the parts that
layouts share. `drawing.py` turns a layout into a level. Lengths are whole units of 1/4096 m, so
NumPy and JAX draw the same bits. The package may import `placement.py` and `sim.noise`.
"""

from swarmjax.task.layouts import barriers, blocks, maze, open_floor, plots
from swarmjax.task.layouts.site import ArenaLayout

LAYOUTS: dict[str, ArenaLayout] = {
    "trap": barriers.TRAP,
    "fence": barriers.FENCE,
    "bay": barriers.BAY,
    "row": barriers.ROW,
    "door": barriers.DOOR,
    "maze": maze.MAZE,
    "blocks": blocks.BLOCKS,
    "circle": open_floor.CIRCLE,
    "crowd": open_floor.CROWD,
    "plots": plots.PLOTS,
}
