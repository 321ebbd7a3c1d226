"""The host side of a run: settings, run directory, checkpoints, display and logs.

This package imports `training` and all packages that `training` imports. `settings.py` defines the
keys of the command `train` and checks them together, and `load_settings.py` reads them.
`lifecycle.py` takes a run from its config to its finished directory. `trainer.py` calls the
compiled program. Start with `lifecycle.carry_out`.
"""
