"""The hand model: parameters, templates, skinning, surface anchors, joint limits, projection.

The stub next to this file (`__init__.pyi`) lists the public names, once: type checkers and editors
read it, and `lazy_loader` imports a name from its module when it is first asked for. Importing
this package therefore loads no torch.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
