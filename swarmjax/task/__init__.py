"""One arena as an environment: levels, observations, rewards and the robots' electronics.

The package imports `sim`. It has no learning code, no curriculum and no batch of arenas. Its whole
interface is `world.load`, `env.reset` and `env.step`. Start reading at `env.step`.
"""
