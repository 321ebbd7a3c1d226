"""Exports policies in other forms: NumPy, ONNX, C99 and a Webots controller.

Imports policy files, sensor responses of `sim`, and `run` to read a run's checkpoint. Start with
`__main__.main`.
"""
