"""The physics that a model can leave out: one effect, one file, found by `registry`."""
