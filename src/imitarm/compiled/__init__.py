"""Compiled code for the control loop, where it has been built; NumPy computes the same without it.

The C sources are in this folder. :func:`build` compiles them to one library with the C compiler of the machine;
``python -m imitarm.compiled`` does the same. Nothing else needs a compiler. The modules that call the library also
contain the NumPy code that is used without it: each function returns the same numbers up to rounding.
"""

from imitarm.compiled.kernels import build, library

__all__ = ["build", "library"]
