"""The robot and its arena: model, body, drive, sensors and physics steps.

From the rest of swarmjax, this package imports only `config` and `epuck.py`. `physics.py` steps
many arenas with MJX. Only `dispatch.py` calls the faster code in `fast/`; every feature also works
without that code. Start reading at `physics.step`. `model.py` builds the MuJoCo model.
"""
