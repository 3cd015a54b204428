"""The page of an avatar: one HTML file in which a hand can be turned, posed and played.

The stub next to this file (`__init__.pyi`) lists the public names, once; a name is imported from
its module when it is first asked for.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
