"""A road graph and another map of the same roads: what stayed, what changed, and what only one of them has."""

from pkgutil import iter_modules

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, [module.name for module in iter_modules(__path__)])
