"""Goals: what robots are asked to do. `task.goal` names the goal.

- goal.py: what every goal defines, and when episodes end. Start reading here.
- navigate.py, lifelong.py, gather.py, cover.py: the built-in goals.

To add a goal, write an extension; see `swarmjax.extension.goal`.
"""
