"""Teach industrial robot arms by demonstration.

The file ``__init__.pyi`` lists the public names. A name is imported only when it is first used, so ``import imitarm``
is fast.
"""

import lazy_loader

__version__ = "0.1.0"
__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
