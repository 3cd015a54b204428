"""HWP-Sim: from a scene description to a capture, with everything that a real one hides.

The names of this package are listed in `__init__.pyi`. `lazy_loader` imports a name from its
module when it is first asked for.
"""

from __future__ import annotations

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
