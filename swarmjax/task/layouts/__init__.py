"""Layouts of arenas with walls; each file draws one layout as a pure function.

`LAYOUTS` lists the layouts by the names that stages use for `level`. `site.py` holds the parts that
layouts share. `drawing.py` turns a layout into a level. Lengths are whole units of 1/4096 m, so
NumPy and JAX draw the same bits. The package may import `placement.py` and `sim.noise`.
"""

from swarmjax.task.layouts import bay, circle, crowd, door, fence, maze, row, trap
from swarmjax.task.layouts.site import ArenaLayout

LAYOUTS: dict[str, ArenaLayout] = {
    "trap": trap.TRAP,
    "fence": fence.FENCE,
    "bay": bay.BAY,
    "row": row.ROW,
    "door": door.DOOR,
    "maze": maze.MAZE,
    "circle": circle.CIRCLE,
    "crowd": crowd.CROWD,
}
