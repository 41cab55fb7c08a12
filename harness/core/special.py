"""SciPy's special functions, without what their import loads for nobody.

SciPy copies every name of NumPy, which makes it load the compiler of Fortran and the tools for
tests: a quarter of its time. They are hidden while it does, and load later for whoever asks NumPy
for them.
"""

import numpy as np

_UNUSED = [name for name in ("f2py", "testing") if name not in vars(np)]
for _name in _UNUSED:
    setattr(np, _name, None)
try:
    from scipy.special import expit, ndtr, ndtri, stdtrit
finally:
    for _name in _UNUSED:
        delattr(np, _name)

__all__ = ["expit", "ndtr", "ndtri", "stdtrit"]
