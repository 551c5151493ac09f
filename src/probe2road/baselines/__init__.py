"""The baselines of the paper: the methods that it compares itself with, from fleet data to a road graph."""

from pkgutil import iter_modules

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, [module.name for module in iter_modules(__path__)])
