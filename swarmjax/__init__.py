"""E-puck swarms in MuJoCo MJX: thousands of arenas, a curriculum and PPO in one compiled program.

Axes, used in every docstring: `T` time, `A` arenas, `R` robots (max), `K` = 8 infrared sensors,
`O` observation, `U` = 2 command, `M` obstacles (max), `S` stages, `L` learners (1 when the policy
is shared, R when every robot has its own). SI units; angles in radians, counter-clockwise, x
forward. A step is always qualified: a physics step, a control step (one per arena), a robot step
(a control step of one robot), a transition (a robot step that was trained on).
"""

__version__ = "0.1.0"
