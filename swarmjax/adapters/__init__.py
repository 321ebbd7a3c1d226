"""How do other libraries step the swarm? One file for each of them (docs/adapters.md).

Each takes what `swarmjax.make_env` returns. `robots.py` lists the robots of all arenas in a row,
and `session.py` steps them from the host; the other files are named after their library. May
import `environment`. Nothing here is imported by `import swarmjax`.
"""
