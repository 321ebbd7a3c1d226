"""The host side of a run: its settings, its directory, checkpoints, what is shown and saved.

Imports `training` and what that does. `settings.py` has the keys of the command `train` and what
joins their sections, `lifecycle.py` takes a run from its config to its finished directory,
`trainer.py` calls the compiled program. Start with `lifecycle.carry_out`.
"""
