"""The fleet simulator: from road networks to 3-D lanes, traffic and sensors, to fleet data with known truth."""

from pkgutil import iter_modules

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach(__name__, [module.name for module in iter_modules(__path__)])
