"""DeepMG (Ruan et al., AAAI 2020): trace features, a network with two decoders, links, and refinement by matching."""

from pkgutil import iter_modules

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, [module.name for module in iter_modules(__path__)])
