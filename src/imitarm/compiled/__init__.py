"""Optional compiled code for the control loop; without this code, NumPy computes the same numbers.

The C sources are in this folder. :func:`build` compiles them to one library with the C compiler of the machine;
``python -m imitarm.compiled`` does the same. No other part of imitarm needs a compiler. If the library was not built,
the modules that call it use their own NumPy code. Both versions of a function return the same numbers, except for
rounding errors.
"""

from imitarm.compiled.kernels import build, library

__all__ = ["build", "library"]
