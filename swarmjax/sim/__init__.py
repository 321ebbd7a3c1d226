"""The robot and its arena: model, body, drive, sensors and physics steps.

Of the rest of swarmjax, this package imports only `config` and `epuck.py`. `physics.py` steps many
arenas with MJX. Only `dispatch.py` uses the faster code of `fast/`; everything works without that
code. Start reading at `physics.step`. `model.py` defines the parts of a robot.
"""
