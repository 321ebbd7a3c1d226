"""`swarmjax COMMAND key=value ...`: the console script, and what shells complete for it.

`swarmjax train` is `python -m swarmjax.train`. A new command is a line in `commands.py`; its module
is imported only when it runs, so that `--help` needs no JAX.
"""
