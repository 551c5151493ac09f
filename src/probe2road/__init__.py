"""Routable road graphs from fleet GNSS traces and camera-detected road features.

The verbs in the order of the pipeline, the options that they take, and every room of the package by attribute. What
there is stands in ``__init__.pyi``; it is imported on first use, so that ``import probe2road`` is quick.
"""

from __future__ import annotations

import lazy_loader

__version__ = "0.1.0.dev0"

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
