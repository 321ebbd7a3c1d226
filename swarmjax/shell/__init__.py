"""The console script `swarmjax COMMAND key=value ...`.

`swarmjax train` is the same as `python -m swarmjax.train`. To add a command, add a line to
`commands.py`. A command's module is imported only when it runs, so that `--help` needs no JAX.
"""
