"""The robot and its world: model, body, drive, sensors and physics steps.

Imports `config` and `epuck.py` alone. `physics.py` steps many arenas by MJX; `dispatch.py` is the
only module that knows the faster ways of `fast/`, and everything works without them. Start with
`physics.step`; `model.py` says what a robot is made of.
"""
