"""Policies in other forms: NumPy's, ONNX, C99 and a Webots controller.

Imports policy files, sensor responses of `sim`, and `run` to read a run's checkpoint. `folder.py`
says which files may be replaced. Start with `__main__.main`.
"""
