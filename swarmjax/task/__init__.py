"""One arena as an environment: levels, observations, rewards and the robots' electronics.

The package imports `sim`. It has no learning code, no curriculum and no batch of arenas. Other
packages use `world.load`, `env.reset` and `env.step`. Start reading at `env.step`.
"""
