"""The host side of a run: settings, run directory, checkpoints, display and logs.

This package imports `training` and all packages that `training` imports. `settings.py` defines the
keys of the command `train` and checks them together, and `load_settings.py` reads them. `run.py`
takes a run from its settings to its finished directory: start with `Run.train`.
"""
