"""Gap filling: dead ends and interrupted roads linked to the roads that they were cut off from."""

from pkgutil import iter_modules

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, [module.name for module in iter_modules(__path__)])
