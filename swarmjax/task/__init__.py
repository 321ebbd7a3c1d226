"""One arena as an environment: levels, observations, rewards and the electronics between.

Imports `sim`. Nothing here knows of learning, of a curriculum or of many arenas: `env.load`,
`env.reset` and `env.step` are the whole interface. Start with `env.step`.
"""
