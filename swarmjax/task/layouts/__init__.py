"""Ways of laying out arenas with walls, each a pure function in a file of its own.

`LAYOUTS` lists them by the name that a stage gives as `level`. `site.py` has what they share,
`drawing.py` makes a level of one. Numbers are whole units of 1/4096 m, so that NumPy and JAX draw
the same bits. May import `placement.py` and `sim.noise`.
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
