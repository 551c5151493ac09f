"""Routable road graphs from fleet GNSS traces and camera-detected road features.

The public verbs, in pipeline order. They are imported on first use, so that ``import probe2road`` is quick.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0.dev0"

if TYPE_CHECKING:
    from probe2road.fleet import Fleet, fleet_from_tables

_HOME = {
    "Fleet": "fleet",
    "fleet_from_tables": "fleet",
}

__all__ = ["Fleet", "__version__", "fleet_from_tables"]


def __getattr__(name: str) -> Any:
    if name in _HOME:
        return getattr(import_module(f"probe2road.{_HOME[name]}"), name)
    raise AttributeError(f"module 'probe2road' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
