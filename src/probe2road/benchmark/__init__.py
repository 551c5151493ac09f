"""The open benchmark: data sets on real road networks with known truth, and the paper's tables made from them."""

from pkgutil import iter_modules

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, [module.name for module in iter_modules(__path__)])
