"""Where a model and a recording differ, and what physics was left out.

`diagnose.diagnose` goes through it: `start` (band, noise, first linearisation), `problem` and `rows` (the equations
in whitened rows), `search` (one effect), `fitter` and `selection` (which effects), `location` (where the rest sits),
`evidence`, `estimates`, `simulation` and `verdict` (what is said of it).
"""
