"""What robots are asked to do: `task.goal` names one.

- goal.py: what every goal defines, and when episodes end; start here.
- navigate.py, lifelong.py, gather.py, cover.py: the built-in goals.

A goal of one's own is an extension; see `swarmjax.extension.goal`.
"""
