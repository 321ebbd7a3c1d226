"""Adapters that let other libraries step the swarm, one file per library (docs/adapters.md).

Each adapter takes the result of `swarmjax.make_env`. `robots.py` lists the robots of all arenas
along one axis, `session.py` steps these robots from the host, and `library.py` imports the other
libraries. Every other file is named after the library that it serves. This package may import
`environment`. `import swarmjax` imports nothing from this package.
"""
